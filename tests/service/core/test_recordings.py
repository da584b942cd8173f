"""Who records, without a door: frames and their storage are real."""

import asyncio
from contextlib import nullcontext

import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray_service.access.owners import Owners
from ultragray_service.core.recordings import IncomingFrame, RecordingStream, record
from ultragray_workers.datasets.recording import RecordingSettings
from ultragray_workers.datasets.store import open_datasets
from ultragray_workers.errors import Draining

FRAME = IncomingFrame(pose=np.eye(4), image=bytes(range(16)))


@pytest.mark.parametrize("ending", [None, Draining, ConnectionResetError])
def test_no_answer_is_cut_off_in_the_middle_by_the_end(tmp_path, ending):
    recordings = open_datasets(tmp_path, str(tmp_path)).recordings
    recordings.begin("liver", RecordingSettings(LinearProbe(20.0, 0.0, 25.0), 4, 4))
    begun, written, frames = [], [], iter([FRAME])

    async def main():
        is_writing, draining = asyncio.Event(), asyncio.Event()

        async def receive():
            if (frame := next(frames, None)) is not None:
                return frame
            await is_writing.wait()
            if ending is Draining:
                draining.set()
                await asyncio.Event().wait()
            if ending is not None:
                raise ending
            return None

        async def send(answer):
            begun.append(answer)
            is_writing.set()
            for _ in range(10):  # a client that reads slowly
                await asyncio.sleep(0)
            written.append(answer)

        await record(RecordingStream(recordings.writer("liver"), 2**20, Owners()), receive, send, draining)

    with nullcontext() if ending is None else pytest.raises(ending):
        asyncio.run(main())
    assert begun == written != []
    assert ending is not None or written[-1].recording.frames == 1

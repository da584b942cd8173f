"""Who records, without a door: frames and their storage are real."""

import asyncio
from contextlib import nullcontext

import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.errors import InvalidArgument
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


def frame(number, shade=0):
    return IncomingFrame(pose=np.eye(4), image=bytes(range(shade, shade + 16)), number=number)


async def put_all(stream, frames):
    """What is told of each frame; None: nothing."""
    told = []
    for one in frames:
        try:
            await stream.put(one)
            told.append(None)
        except InvalidArgument as error:
            told.append(str(error))
    await stream.stored()
    return told


def test_a_frame_that_is_sent_again_is_left_out_and_another_one_of_its_number_is_refused(tmp_path):
    recordings = open_datasets(tmp_path, str(tmp_path)).recordings
    recordings.begin("liver", RecordingSettings(LinearProbe(20.0, 0.0, 25.0), 4, 4))

    def told_of(*frames):
        return asyncio.run(put_all(RecordingStream(recordings.writer("liver"), 2**20, Owners()), frames))

    assert told_of(frame(0), frame(1), frame(1), frame(0), frame(3), frame(2)) == [
        *[None] * 5,
        "number must be at least 4, the next of this recording, got 2 with a frame that is not stored under it: a "
        "sweep goes on counting where the one before ended, or leaves number out",
    ]
    assert told_of(frame(3), frame(4)) == [None, None]  # after a lost connection
    second = told_of(frame(0, shade=9), frame(1, shade=9), frame(None, shade=9))
    assert ["got 0 with" in second[0], "got 1 with" in second[1], second[2]] == [True, True, None]
    assert [one.number for block in recordings.frames("liver") for one in block] == [0, 1, 3, 4, 5]

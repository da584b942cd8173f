"""Streams whose client or transport fails, and open streams and their watchers, without a door."""

import asyncio
import gc
from types import SimpleNamespace

import numpy as np
import pytest

from ultragray.errors import InvalidArgument, UltragrayError
from ultragray_service.access.principals import Principal, Role, act_as
from ultragray_service.core.open_streams import MAX_NAME, OpenStream, OpenStreams, StreamAnswer
from ultragray_service.core.streams import FrameStream, PoseRequest, PoseStream, StreamMode
from ultragray_service.errors import StreamNotFound
from ultragray_service.settings import Settings
from ultragray_service.wiring import make_service


@pytest.fixture
def service(tmp_path):
    """A service that has not been started."""
    return make_service(Settings(data_folder=tmp_path))


def test_a_connection_that_breaks_fails_reading_and_writing_at_once_and_neither_failure_is_forgotten(service):
    forgotten = []

    async def main():
        asyncio.get_running_loop().set_exception_handler(lambda _, context: forgotten.append(context))
        broken = asyncio.Event()
        stream = PoseStream(service.rendering)

        async def read():
            await stream.refuse(1, None, UltragrayError("so that there is something to write"))
            await broken.wait()
            raise ConnectionResetError("read")

        async def write(answered):
            await broken.wait()
            raise ConnectionResetError("write")

        asyncio.get_running_loop().call_later(0.05, broken.set)
        with pytest.raises(ConnectionResetError):
            await stream.run(read, write, write)
        gc.collect()
        await asyncio.sleep(0)

    asyncio.run(main())
    assert forgotten == []


def test_a_stream_that_is_refused_as_a_whole_is_not_ended_in_the_middle_of_an_answer(service):
    written = []

    async def main():
        stream, writing = PoseStream(service.rendering), asyncio.Event()

        async def read():
            await stream.refuse(1, None, UltragrayError("so that there is something to write"))
            await writing.wait()
            raise InvalidArgument("no such mode", field="mode")

        async def write(answered):
            writing.set()
            await asyncio.sleep(0.05)
            written.append(answered)

        with pytest.raises(InvalidArgument):
            await stream.run(read, write, write)

    asyncio.run(main())
    assert len(written) == 1


class Endless:
    """A frame that never comes."""

    is_closed = False

    async def frames(self):
        await asyncio.Event().wait()

    def close(self):
        self.is_closed = True


@pytest.mark.parametrize("times", [1, 2])
@pytest.mark.parametrize("frames_per_s", [None, 1])
def test_a_stream_that_is_cancelled_leaves_nothing_in_the_pool(service, monkeypatch, frames_per_s, times):
    """Neither the frame under way nor the pose that waits for its client to acknowledge another."""
    rendering, asked = service.rendering, []

    def ask(*_, **__):
        asked.append(Endless())
        return asked[-1]

    async def turn(deadline):
        await asyncio.sleep(0)

    monkeypatch.setattr(rendering, "ask", ask)
    monkeypatch.setattr(rendering, "limits", SimpleNamespace(mine=SimpleNamespace(frames_per_s=frames_per_s)))
    rendering.limits.frame_turn = turn

    async def main(window):
        stream = PoseStream(rendering)
        stream.mode = StreamMode.LATEST
        stream.open_window(window)

        async def read():
            await stream.ask(PoseRequest(1, None, None, None, np.eye(4), None, 0.0))
            await asyncio.Event().wait()

        async def write(answer):
            raise AssertionError("there is no frame")

        running = asyncio.create_task(stream.run(read, write, write))
        await asyncio.sleep(0.02)
        for _ in range(times):
            running.cancel()
            await asyncio.sleep(0)
        await asyncio.wait({running})
        await asyncio.sleep(0.02)

    for window in (0, 1):
        asyncio.run(main(window))
    assert len(asked) == 1
    assert all(one.is_closed for one in asked)


class Faulty:
    """A message whose reading meets a fault of the service."""

    sequence, client_time, asks = 7, 1.5, True
    window = acknowledged = stamps = None

    def mode(self):
        return StreamMode.ORDERED

    def real(self):
        return None

    def settings(self):
        raise OverflowError("cannot convert float infinity to integer")


class FaultyTransport:
    """Brings one such message, and takes answers."""

    destination = None

    def __init__(self):
        self.messages = iter([Faulty()])
        self.answers = []

    async def receive(self):
        return next(self.messages, None)

    async def send(self, answered):
        self.answers.append(answered)

    hand_over = send


def test_a_fault_at_one_message_is_told_and_the_stream_goes_on(service):
    transport = FaultyTransport()
    asyncio.run(FrameStream(service.rendering, transport).run())
    (answer,) = transport.answers
    assert (answer.sequence, answer.client_time) == (7, 1.5)
    assert isinstance(answer.outcome, UltragrayError)
    assert answer.outcome.reason == "INTERNAL"


ALICE, BOB = (Principal(name, Role.READER, "key") for name in ("alice", "bob"))
ADMIN = Principal("root", Role.ADMIN, "key")


def refusal(sequence, **others):
    return StreamAnswer(sequence, None, UltragrayError("not this one"), **others)


def act(principal):
    act_as(principal, address="10.0.0.7", connection="ipv4:10.0.0.7:5000")


def test_a_slow_watcher_gets_the_newest_answer_alone_and_then_the_end():
    async def main():
        stream, taken = OpenStream(), []
        with stream.watched() as watcher:
            for sequence in range(5):
                stream.note(refusal(sequence))
            stream.end()
            while (answered := await watcher.next()) is not None:
                taken.append(answered.sequence)
        return taken

    assert asyncio.run(main()) == [4]


def test_a_watcher_that_has_gone_is_told_nothing():
    async def main():
        stream = OpenStream()
        with stream.watched():
            assert stream.summary().watchers == 1
        stream.note(refusal(1))
        assert stream.summary().watchers == 0

    asyncio.run(main())


@pytest.mark.usefixtures("clock")
def test_a_summary_counts_what_came_and_what_was_answered():
    stream = OpenStream(name="UR5 \n" + "x" * 200)
    for sequence in range(3):
        stream.count_pose()
        stream.note(refusal(sequence, dropped=2))
    told = stream.summary()
    assert (told.poses, told.frames, told.refused, told.dropped) == (3, 0, 3, 6)
    assert (told.scene, told.pose) == (None, None)
    assert told.poses_per_s == 1.5
    assert told.name.startswith("UR5 x")
    assert len(told.name) == MAX_NAME


def test_streams_are_seen_by_their_owner_and_by_admins():
    async def main():
        streams = OpenStreams()
        act(ALICE)
        with streams.opened("grpc", "robot") as stream:
            assert [one.client for one in streams.seen()] == ["10.0.0.7:5000"]
            assert streams.get(stream.id) is stream
            act(BOB)
            assert streams.seen() == []
            with pytest.raises(StreamNotFound):
                streams.get(stream.id)
            act(ADMIN)
            assert [one.owner for one in streams.seen()] == ["alice"]
            assert streams.seen("liver") == []
        assert streams.seen() == []

    asyncio.run(main())

"""A stream whose client, or whose transport, fails."""

import asyncio
import gc

import pytest

from ultragray.errors import InvalidArgument, UltragrayError
from ultragray_service.core.streams import FrameStream, PoseStream, StreamMode
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


class Faulty:
    """A message whose reading meets a fault of the service."""

    sequence, client_time, asks = 7, 1.5, True
    window = acknowledged = None

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

    def mode(self, message):
        return StreamMode.ORDERED

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

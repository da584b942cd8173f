"""A stream whose client, or whose transport, fails."""

from __future__ import annotations

import asyncio
import gc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ultragray.errors import InvalidArgument, UltragrayError
from ultragray_service.core.streams import FrameStream, PoseStream, StreamAnswer, StreamMode
from ultragray_service.service import Service
from ultragray_service.settings import Settings
from ultragray_service.wiring import make_service


@pytest.fixture
def service(tmp_path: Path) -> Service:
    """A service that has not been started."""
    return make_service(Settings(data_folder=tmp_path))


def test_a_connection_that_breaks_fails_reading_and_writing_at_once_and_neither_failure_is_forgotten(
    service: Service,
) -> None:
    forgotten: list[Any] = []

    async def main() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: forgotten.append(context))
        broken = asyncio.Event()
        stream = PoseStream(service.rendering)

        async def read() -> None:
            await stream.refuse(1, None, UltragrayError("so that there is something to write"))
            await broken.wait()
            raise ConnectionResetError("read")

        async def write(answered: StreamAnswer) -> None:
            await broken.wait()
            raise ConnectionResetError("write")

        asyncio.get_running_loop().call_later(0.05, broken.set)
        with pytest.raises(ConnectionResetError):
            await stream.run(read, write, write)
        gc.collect()
        await asyncio.sleep(0)

    asyncio.run(main())
    assert forgotten == []


def test_a_stream_that_is_refused_as_a_whole_is_not_ended_in_the_middle_of_an_answer(service: Service) -> None:
    written: list[StreamAnswer] = []

    async def main() -> None:
        stream, writing = PoseStream(service.rendering), asyncio.Event()

        async def read() -> None:
            await stream.refuse(1, None, UltragrayError("so that there is something to write"))
            await writing.wait()
            raise InvalidArgument("no such mode", field="mode")

        async def write(answered: StreamAnswer) -> None:
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

    def mode(self) -> StreamMode:
        return StreamMode.ORDERED

    def settings(self) -> Any:
        raise OverflowError("cannot convert float infinity to integer")


class FaultyTransport:
    """Brings one such message, and takes answers."""

    destination = None

    def __init__(self) -> None:
        self.messages: Iterator[Faulty] = iter([Faulty()])
        self.answers: list[StreamAnswer] = []

    async def receive(self) -> Any:
        return next(self.messages, None)

    async def send(self, answered: StreamAnswer) -> None:
        self.answers.append(answered)

    hand_over = send


def test_a_fault_at_one_message_is_told_and_the_stream_goes_on(service: Service) -> None:
    transport = FaultyTransport()
    asyncio.run(FrameStream(service.rendering, transport).run())
    (answer,) = transport.answers
    assert (answer.sequence, answer.client_time) == (7, 1.5)
    assert isinstance(answer.outcome, UltragrayError)
    assert answer.outcome.reason == "INTERNAL"

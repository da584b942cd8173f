"""Large bodies are read beside the event loop, which serves others meanwhile."""

from __future__ import annotations

import asyncio
import threading

import pytest

from ultragray_service.http import bodies


def test_the_loop_goes_on_while_a_large_body_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    begun, may_end = threading.Event(), threading.Event()

    def read(*_: object) -> str:
        begun.set()
        assert may_end.wait(60)
        return "read"

    async def main() -> None:
        reading = asyncio.ensure_future(bodies.read_large(b'""', str, None))
        while not begun.is_set():
            await asyncio.sleep(0.001)
        assert not reading.done()
        may_end.set()
        assert await reading == "read"

    monkeypatch.setattr(bodies, "_read", read)
    asyncio.run(main())

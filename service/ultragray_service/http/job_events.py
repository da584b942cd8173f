"""A job's progress as server-sent events."""

from __future__ import annotations

from collections.abc import AsyncIterator

from starlette.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from ultragray_workers.jobs.job import Job

from ..core.jobs.hub import JobChange, JobWatch
from .reading.json_body import adapter_of

EVENTS_TYPE = "text/event-stream"
KEEP_ALIVE_S = 15.0


class JobEvents(StreamingResponse):
    """Answers with the events of a watch, and closes it when the job is final or the client has gone."""

    def __init__(self, watch: JobWatch) -> None:
        super().__init__(
            _events(watch),
            media_type=EVENTS_TYPE,
            headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},  # the second: proxies pass it on at once
        )
        self._watch = watch

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._watch.close()


async def _events(watch: JobWatch) -> AsyncIterator[bytes]:
    while (change := await watch.next(KEEP_ALIVE_S)) is not None:
        yield _written(change) or b": still here\n\n"


def _written(change: JobChange) -> bytes:
    text = ""
    if change.log:
        text += _event("log", change.log)
    if change.job is not None:
        text += _event("progress", adapter_of(Job).dump_json(change.job).decode())
    return text.encode()


def _event(name: str, data: str) -> str:
    lines = "".join(f"data: {line}\n" for line in data.replace("\r", "\n").splitlines())
    return f"event: {name}\n{lines}\n"

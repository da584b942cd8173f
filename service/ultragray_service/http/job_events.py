"""A job's progress as server-sent events, which go on where a client left off.

The id of an event is a place in the log and a digest of the job as it was told last: all that a client knows then.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import AsyncIterator
from dataclasses import dataclass, replace

from starlette.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from ultragray_service.core.jobs.hub import JobChange, JobWatch
from ultragray_service.http.reading.json_body import adapter_of
from ultragray_workers.jobs.job import Job

EVENTS_TYPE = "text/event-stream"
KEEP_ALIVE_S = 15.0
RETRY_MS = 1000  # after which a client whose stream broke asks again
_ID = re.compile(r"([0-9]{1,15})-([0-9a-f]{16})?")
_DIGEST_BYTES = 8


@dataclass(frozen=True)
class LastEvent:
    """What a client knows after an event: the log up to a byte, and the job by its digest. None: nothing."""

    log_offset: int | None = None
    digest: str | None = None

    def __str__(self) -> str:
        return f"{self.log_offset or 0}-{self.digest or ''}"

    @classmethod
    def read(cls, event_id: str) -> LastEvent:
        """The inverse of `str`; for the id of another stream: nothing is known."""
        if (found := _ID.fullmatch(event_id)) is None:
            return cls()
        return cls(int(found[1]), found[2])


class JobEvents(StreamingResponse):
    """Answers with the events of a watch, and closes it when the job is final or the client has gone."""

    def __init__(self, watch: JobWatch, last: LastEvent) -> None:
        super().__init__(
            _events(watch, last),
            media_type=EVENTS_TYPE,
            headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},  # the second: proxies pass it on at once
        )
        self._watch = watch

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._watch.close()


async def _events(watch: JobWatch, last: LastEvent) -> AsyncIterator[bytes]:
    yield f"retry: {RETRY_MS}\n\n".encode()
    while (change := await watch.next(KEEP_ALIVE_S)) is not None:
        text, last = _written(change, last)
        yield text.encode() or b": still here\n\n"


def _written(change: JobChange, last: LastEvent) -> tuple[str, LastEvent]:
    """The events of a change, and the id of the last of them."""
    text = ""
    if change.log:
        last = replace(last, log_offset=change.log_offset)
        text += _event("log", last, change.log)
    if change.job is not None:
        job = adapter_of(Job).dump_json(change.job)
        digest = hashlib.blake2b(job, digest_size=_DIGEST_BYTES).hexdigest()
        if digest != last.digest:
            last = LastEvent(change.log_offset, digest)
            text += _event("progress", last, job.decode())
    return text, last


def _event(name: str, event_id: LastEvent, data: str) -> str:
    whole = data.replace("\r\n", "\n").replace("\r", "\n").removesuffix("\n")
    lines = "".join(f"data: {line}\n" for line in whole.split("\n"))
    return f"event: {name}\nid: {event_id}\n{lines}\n"

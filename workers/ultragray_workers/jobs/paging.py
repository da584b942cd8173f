"""The tokens of pages of jobs, newest first: the place between two jobs, which later jobs do not move."""

from __future__ import annotations

import base64
import binascii
import json
from datetime import datetime, timezone

from ultragray.errors import InvalidArgument


def iso_after(epoch_ms: int) -> str:
    """Half a millisecond later: DBOS rounds down, and may by then have lost the last bit."""
    return datetime.fromtimestamp((epoch_ms + 0.5) / 1000, timezone.utc).isoformat()


def write_token(last_ms: int, seen: list[str]) -> str:
    """The place after the last job of a page; `seen`: the jobs of that very millisecond that were told already."""
    return base64.urlsafe_b64encode(json.dumps([last_ms, seen]).encode()).decode()


def read_token(token: str) -> tuple[int, list[str]]:
    """Inverse of `write_token`. Raises InvalidArgument."""
    try:
        last_ms, seen = json.loads(base64.urlsafe_b64decode(token))
        is_seen = isinstance(seen, list) and all(isinstance(job_id, str) for job_id in seen)
        if isinstance(last_ms, int) and 0 <= last_ms < 2**43 and is_seen:
            return last_ms, seen
    except (ValueError, TypeError, RecursionError, binascii.Error):
        pass
    raise InvalidArgument(f"page_token must be one that a page gave, got {token[:64]!r}", field="page_token")

"""How much one key may take, and how people write it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from ultragray.contract import Contract, annotated_fields, described, from_text
from ultragray.errors import InvalidArgument

Number = int | float
GB = 10**9
_UNLIMITED = "none"
_FIELD = "limit"


@dataclass(frozen=True, kw_only=True)
class Allowance(Contract):
    """How much one name may take, with however many keys; None: no limit."""

    requests_per_s: int | None = described(
        "Requests and calls of one key in any second; a stream is one; none: any number.",
        None,
        low=1,
        high=1_000_000,
    )
    frames_per_s: int | None = described(
        "Frames of one key in any second, asked for one by one, in batches and in streams; none: any number.",
        None,
        low=1,
        high=1_000_000,
    )
    streams: int | None = described(
        "Streams of one key at once, over WebSocket, gRPC and OpenIGTLink; none: any number.",
        None,
        low=0,
        high=1_000_000,
    )
    unfinished_jobs: int | None = described(
        "Jobs of one key that wait or run at once; none: any number.", None, low=0, high=100_000
    )
    running_jobs: int | None = described(
        "Jobs of one key that run at once; more wait, and jobs of others go first; none: any number.",
        None,
        low=1,
        high=100_000,
    )
    compute_minutes_per_day: float | None = described(
        "Minutes that the jobs of one key may have run since midnight (UTC), on CPU and GPU together; then it submits "
        "no more that day; none: any number.",
        None,
        low=0.0,
        high=1e9,
    )
    stored_gb: float | None = described(
        "GB (1e9 bytes) of datasets, scenes and artifacts of one key; then it uploads and submits nothing; none: any "
        "number.",
        None,
        low=0.0,
        high=1e9,
    )
    registrations: int | None = described(
        "Registrations that one key keeps; none: any number.", None, low=0, high=1_000_000
    )


def of_key(name: str) -> Any:
    """The setting of the service that limits every key as the field `name` of an Allowance says."""
    (item,) = (item for item, _ in annotated_fields(Allowance) if item.name == name)
    return field(default=item.default, metadata=item.metadata)


NAMES = tuple(item.name for item, _ in annotated_fields(Allowance))


def read_limits(texts: Sequence[str]) -> dict[str, Number | None]:
    """The limits that `frames_per_s=30` or `streams=none` give. Raises InvalidArgument."""
    annotations = {item.name: annotation for item, annotation in annotated_fields(Allowance)}
    found: dict[str, Number | None] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if name not in annotations or not equals:
            raise InvalidArgument(
                f"limit must be NAME=NUMBER or NAME={_UNLIMITED}, with a NAME of {', '.join(NAMES)}, got {text!r}",
                field=_FIELD,
            )
        read: Any = None if value == _UNLIMITED else from_text(value, annotations[name])
        found[name] = getattr(Allowance(**{name: read}), name)
    return found

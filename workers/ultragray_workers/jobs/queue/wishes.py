"""The wishes of administrators for workers."""

from __future__ import annotations

from enum import Enum


class Wanted(str, Enum):
    """A wish for a worker, which holds until another one, restarts of the worker included."""

    WORK = "work"  # it takes jobs
    PAUSE = "pause"  # it takes none, and ends the job at hand
    DRAIN = "drain"  # it takes none; a training at hand goes back into the queue at once, other jobs are ended


def wanted_of(kept: str | None) -> Wanted:
    """The wish in a row of the workers; one of a newer release counts as the most careful."""
    if kept is None:
        return Wanted.WORK
    return Wanted(kept) if kept in {one.value for one in Wanted} else Wanted.PAUSE

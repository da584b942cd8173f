"""What the processes of a service take: resident memory and open descriptors, of each that lives."""

import contextlib
import os
import statistics
from dataclasses import dataclass
from pathlib import Path

_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
HELPER = "helper"  # works on one thing and ends
_GONE = (FileNotFoundError, ProcessLookupError)


@dataclass(frozen=True)
class Taken:
    """What one process takes at one moment."""

    role: str
    resident_bytes: int
    descriptors: int


def taken_by(pid):
    """Raises FileNotFoundError or ProcessLookupError where there is no such process."""
    folder = Path(f"/proc/{pid}")
    return Taken(
        role=_role(folder),
        resident_bytes=int((folder / "statm").read_text().split()[1]) * _PAGE_BYTES,
        descriptors=len(list((folder / "fd").iterdir())),
    )


def _role(folder):
    """The name that a process of the pool gives itself; else its module; else that it is a helper."""
    name = (folder / "comm").read_text().strip()
    if name.startswith("ug-"):
        return name
    arguments = (folder / "cmdline").read_text().split("\0")
    return arguments[arguments.index("-m") + 1] if "-m" in arguments else HELPER


def family(pid):
    """A process and its descendants, by process id."""
    children = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with contextlib.suppress(*_GONE):
                parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
                children.setdefault(parent, []).append(int(folder.name))
    found, waiting = {}, [pid]
    while waiting:
        waiting += children.get(one := waiting.pop(), [])
        with contextlib.suppress(*_GONE):
            found[one] = taken_by(one)
    return found


@dataclass(frozen=True)
class Growth:
    """How much more there was in the last part of a series than in an earlier one, as medians."""

    earlier: float
    last: float

    @classmethod
    def of(cls, series, parts):
        """Compares the second of `parts` equal parts, after the warm-up, with the last."""
        size = max(1, len(series) // parts)
        return cls(statistics.median(series[size : 2 * size] or series), statistics.median(series[-size:]))

    @property
    def absolute(self):
        return self.last - self.earlier

    @property
    def share(self):
        """1.0: twice as much."""
        return self.absolute / self.earlier if self.earlier else 0.0


def by_role(samples):
    """Samples of families as series by role: memory and descriptors of all processes that have it together."""
    series = {}
    for sample in samples:
        totals = {}
        for taken in sample.values():
            total = totals.setdefault(taken.role, {"resident_bytes": 0, "descriptors": 0})
            total["resident_bytes"] += taken.resident_bytes
            total["descriptors"] += taken.descriptors
        for role, total in totals.items():
            series.setdefault(role, []).append(total)
    return series

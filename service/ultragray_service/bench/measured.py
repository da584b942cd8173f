"""The head of a file of measured figures: the commit, the date and the machine that they belong to."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from ultragray.installation import memory_bytes, processor_maker, processor_model, processor_name
from ultragray.rendering.backends import cpu

ROOT = Path(__file__).resolve().parents[3]  # of the checkout, where this is one
DIRTY = "-dirty"
_COMMIT_CHARACTERS = 12
_WRITTEN_BY_RECORDING = (
    "benchmarks/*.json",
    "tests/*-run.json",
    "README.md",
    "docs/*.md",
    "docs/images/*_reliability.png",
    "docs/images/scaling.png",
)


def measured(threads: int) -> dict[str, Any]:
    """The head, taken now; `threads` are those of what is measured."""
    return {
        "commit": commit(),
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "machine": {
            "maker": processor_maker(),
            "processor": processor_name(),
            "model": processor_model(),
            "instruction_set": cpu.INSTRUCTION_SETS[0],
            "threads": threads,
            "cores": os.cpu_count(),
            "memory_gib": round(memory_bytes() / 2**30, 1),
        },
    }


def main() -> None:
    """Print the head for what other programs measure, on all cores."""
    sys.stdout.write(json.dumps(measured(os.cpu_count() or 1)) + "\n")


def commit() -> str | None:
    """The commit of the checkout, with -dirty where its sources have changed since; None where this is no checkout."""
    if not _is_checkout():
        return None
    head = _git("rev-parse", f"--short={_COMMIT_CHARACTERS}", "HEAD")
    return head + DIRTY if head and changed_sources() else head


def changed_sources() -> list[str]:
    """Files of the checkout that differ from its commit, new ones too; not the figures and documents that recording
    writes."""
    spared = [f":(exclude){pattern}" for pattern in _WRITTEN_BY_RECORDING]
    status = _git("status", "--porcelain", "--untracked-files=all", "--no-renames", "--", ".", *spared)
    return [line[3:] for line in (status or "").splitlines()]


def _is_checkout() -> bool:
    """Whether the sources are a checkout of their own, and not installed below somebody else's."""
    top = _git("rev-parse", "--show-toplevel")
    return top is not None and Path(top).resolve() == ROOT


def _git(*words: str) -> str | None:
    """What a git command prints; None where there is no git, or it refuses."""
    command = ["git", "--no-optional-locks", "-C", str(ROOT), *words]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.rstrip()
    except (OSError, subprocess.CalledProcessError):
        return None


if __name__ == "__main__":
    main()

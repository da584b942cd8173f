"""Puts newly measured figures in the place of those under version control: `make TARGET RECORD=1`.

    python benchmarks/record.py --ready      refuse a checkout with uncommitted changes, before hours are spent
    python benchmarks/record.py NAME ...     figures of this commit, from build/bench; then write the documents

Of a file that is measured run by run, the runs of this commit take the place of those of the same name, and the
others stay. Figures of another commit, or taken with uncommitted changes, are never recorded.
"""

from __future__ import annotations

import argparse
import json
import sys

import confidence
import documents
import simulation
from registry import FIGURES, Document, Figures
from ultragray.files import write_whole
from ultragray_studies.bench.report import changed_sources, commit

SHOWN = 3  # names of changed files


class NotRecordable(Exception):
    """The figures cannot be recorded; the message says why."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", choices=[[], *FIGURES], metavar="NAME", help=", ".join(FIGURES))
    parser.add_argument("--ready", action="store_true", help="say whether the checkout can be recorded from, no more")
    given = parser.parse_args()
    try:
        here = recordable_commit()
        if not given.ready:
            taken = {name: taken_over(FIGURES[name], here) for name in given.names}
            for name, document in taken.items():
                write_whole(FIGURES[name].kept, json.dumps(document, indent=1, allow_nan=False) + "\n")
            documents.write()
            if "confidence" in taken:
                confidence.draw(taken["confidence"])
            if "simulation" in taken:
                simulation.draw(taken["simulation"])
    except NotRecordable as error:
        sys.exit(f"error: {error}")


def recordable_commit() -> str:
    """The commit that figures are recorded for.

    Raises NotRecordable where there is none, or the sources differ from it.
    """
    here = commit()
    if here is None:
        raise NotRecordable("figures are recorded with their commit, and this is no checkout of git")
    if changed := changed_sources():
        names = ", ".join(changed[:SHOWN]) + (f" and {len(changed) - SHOWN} more" if len(changed) > SHOWN else "")
        raise NotRecordable(f"figures are recorded of a commit; commit or stash these changes first: {names}")
    return here


def taken_over(file: Figures, here: str) -> Document:
    """The new content of a file under version control.

    Raises NotRecordable where the commit has not been measured.
    """
    staged = json.loads(file.staged.read_text(encoding="utf-8")) if file.staged.exists() else {}
    fresh = _of_commit(staged, here)
    if fresh.get("quick"):
        raise NotRecordable(f"{file.staged} is of a quick run; measure it whole with make {file.target}")
    if not fresh:
        raise NotRecordable(f"{file.staged} has no figures of commit {here}; measure them with make {file.target}")
    kept = json.loads(file.kept.read_text(encoding="utf-8")) if file.kept.exists() else {}
    return _merged(kept, fresh)


def _of_commit(document: Document, here: str) -> Document:
    """The document, or those of its runs, that a commit is the origin of; empty where it is of none."""
    if "measured" in document:
        return document if document["measured"]["commit"] == here else {}
    return {name: found for name, part in document.items() if (found := _of_commit(part, here))}


def _merged(kept: Document, fresh: Document) -> Document:
    if "measured" in fresh:
        return fresh
    return {**kept, **{name: _merged(kept.get(name, {}), part) for name, part in fresh.items()}}


if __name__ == "__main__":
    main()

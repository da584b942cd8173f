"""Measured figures: one way to take them, to record them, and to write them into the documents.

    python benchmarks/figures.py ready            refuse a checkout with uncommitted changes, before hours are spent
    python benchmarks/figures.py record NAME ...  figures of this commit, from build/bench, to the place of those that
                                                  are under version control; then write the documents
    python benchmarks/figures.py show TARGET      print the tables of what a target left in build/bench
    python benchmarks/figures.py list             commit, date and machine of all figures, and the commits since
    python benchmarks/figures.py check            fail where a document does not hold what the files say

A file is JSON that begins with `measured`: commit, date, machine; or it holds runs by name, each of which begins so. In
documents, a table stands between `<!-- measured: NAME -->` and `<!-- end -->`; BLOCKS in tables.py makes it.
"""

from __future__ import annotations

import argparse
import json
import logging
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from ultragray.files import write_whole
from ultragray_studies.bench.report import DIRTY, changed_sources, commit, measured

ROOT = Path(__file__).resolve().parents[1]
STAGE = ROOT / "build" / "bench"  # where targets of the Makefile measure into; git ignores it
SECONDS_PER_LINE = 15.0
_PLACE = re.compile(r"(?<=<!-- measured: )([\w ,-]+?)( -->\n).*?(?=<!-- end -->)", flags=re.DOTALL)
_SHOWN = 3  # names of changed files

Document = dict[str, Any]

# Every file of figures, with the target of the Makefile that measures it.
TARGETS = {
    **dict.fromkeys(("results", "kernel", "training", "jobs", "clients"), "bench"),
    "console": "bench-console",
    **dict.fromkeys(("cuda", "cuda_training"), "bench-cuda"),
    "results_tables": "results",
    "methods_tables": "methods",
    **{name: name for name in ("ablations", "poses", "localization", "confidence", "libraries", "environment")},
    **{name: name for name in ("ros", "simulation")},
    "shards": "test-shards",
    **{f"{name}-run": f"test-{name}" for name in ("long", "soak", "replicas", "overload")},
}

log = logging.getLogger("figures")


class NotRecordable(Exception):
    """The figures cannot be recorded; the message says why."""


def kept(name: str) -> Path:
    """The file that is under version control."""
    return ROOT / ("tests" if name.endswith("-run") else "benchmarks") / f"{name}.json"


def staged(name: str) -> Path:
    """The file as its target leaves it."""
    return STAGE / f"{name}.json"


def read(path: Path) -> Document:
    """A file of figures; empty where there is none yet."""
    return dict(json.loads(path.read_text(encoding="utf-8"))) if path.exists() else {}


def write(name: str, document: Document) -> None:
    """Leave a file of figures to be recorded."""
    staged(name).parent.mkdir(parents=True, exist_ok=True)
    write_whole(staged(name), json.dumps(document, indent=1, allow_nan=False) + "\n")


Run = Callable[[Path], Document]  # measures one run, given the folder of the data sets


def measure_runs(name: str, about: str | None, runs: Mapping[str, Run], *, threads: int = 0) -> None:
    """The program of a file that is measured run by run: `DATA_FOLDER [--only NAME ...]`.

    A run's figures are written as soon as it is done, and it is not repeated at the same commit: a killed program goes
    on. `threads`: 0 for all cores.
    """
    parser = argparse.ArgumentParser(description=(about or "").partition("\n")[0])
    parser.add_argument("data_folder", type=Path, help="folder of the data sets")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="runs whose names begin so: " + ", ".join(runs))
    given = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    if threads:
        torch.set_num_threads(threads)
    for run, take in runs.items():
        if given.only is None or run.startswith(tuple(given.only)):
            head = measured(torch.get_num_threads())
            known = read(staged(name)).get(run)
            if known is not None and known["measured"]["commit"] == head["commit"] and not is_dirty(head):
                continue
            log.info("%s", run)
            write(name, {**read(staged(name)), run: {**take(given.data_folder), "measured": head}})


def is_dirty(head: Document) -> bool:
    """Whether figures belong to no commit: the sources had changes, or were no checkout."""
    return head["commit"] is None or head["commit"].endswith(DIRTY)


def teller(name: str) -> Callable[[Any], None]:
    """Says every quarter of a minute how far a training is."""
    last_s = time.monotonic()

    def tell(progress: Any) -> None:
        nonlocal last_s
        if time.monotonic() - last_s >= SECONDS_PER_LINE:
            last_s = time.monotonic()
            log.info("%s: step %d of %d, loss %.4f", name, progress.step, progress.steps, progress.loss)

    return tell


def recordable_commit() -> str:
    """The commit that figures are recorded for. Raises NotRecordable where there is none, or the sources differ."""
    here = commit()
    if here is None:
        raise NotRecordable("figures are recorded with their commit, and this is no checkout of git")
    if changed := changed_sources():
        names = ", ".join(changed[:_SHOWN]) + (f" and {len(changed) - _SHOWN} more" if len(changed) > _SHOWN else "")
        raise NotRecordable(f"figures are recorded of a commit; commit or stash these changes first: {names}")
    return here


def to_record(name: str, here: str) -> Document:
    """The new content of a file: figures of a commit, in place of its runs of the same names.

    Raises NotRecordable where the commit has not been measured.
    """
    found = read(staged(name))
    fresh = found if "measured" in found else {run: one for run, one in found.items() if _is_of(one, here)}
    if fresh.get("quick"):
        raise NotRecordable(f"{staged(name)} is of a quick run; measure it whole with make {TARGETS[name]}")
    if not fresh or ("measured" in fresh and not _is_of(fresh, here)):
        raise NotRecordable(f"{staged(name)} has no figures of commit {here}; measure them with make {TARGETS[name]}")
    return fresh if "measured" in fresh else {**read(kept(name)), **fresh}


def _is_of(document: Document, here: str) -> bool:
    return bool(document["measured"]["commit"] == here)


def heads(document: Document) -> Iterator[Document]:
    """The heads of a file: its one, or one of each run."""
    if "measured" in document:
        yield document["measured"]
        return
    for part in document.values():
        yield from heads(part)


def described(document: Document) -> str:
    """Commits, dates and machines in words, each combination once."""
    return "; ".join(
        sorted({f"commit {one['commit']}, {one['date'][:10]}, {in_words(one['machine'])}" for one in heads(document)})
    )


def in_words(machine: Document) -> str:
    """A machine; figures of earlier commits do not say everything about theirs."""
    model, memory = machine.get("model"), machine.get("memory_gib")
    threads, cores = machine.get("threads"), machine.get("cores")
    of_cores = "" if cores is None else f"{cores} cores"
    parts = (
        f"{machine['processor']} ({model})" if model else machine["processor"],
        machine.get("instruction_set"),
        " on ".join(part for part in (f"{threads} thread{'s'[: threads != 1]}" if threads else "", of_cores) if part),
        f"{memory:.0f} GiB" if memory else None,
    )
    return ", ".join(part for part in parts if part)


def documents() -> list[Path]:
    """README.md and everything below docs/ that has a place for figures."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [page for page in pages if _PLACE.search(page.read_text(encoding="utf-8"))]


def current(text: str, read_kept: Callable[[str], Document] = lambda name: read(kept(name))) -> str:
    """A document with the figures as the files have them."""
    from tables import BLOCKS

    def block(place: re.Match[str]) -> str:
        one = BLOCKS[place[1]]
        lines = [*one.of(read_kept(one.source)), ""]
        lines[-2] = f"`{kept(one.source).relative_to(ROOT)}`: {lines[-2]}"
        return f"{place[1]}{place[2]}" + "\n".join(lines)

    return _PLACE.sub(block, text)


def show(target: str) -> None:
    """Print the tables of what a target measured."""
    from tables import BLOCKS

    for name, one in BLOCKS.items():
        if TARGETS[one.source] == target and (found := read(staged(one.source))):
            sys.stdout.write("\n".join((f"# {name}", "", *one.of(found), "", "")))


def listing() -> Iterator[str]:
    """Each file with its origin, and how many commits of the product have come since."""
    for name in TARGETS:
        if not (found := read(kept(name))):
            yield f"{name}: not measured yet (make {TARGETS[name]} RECORD=1)"
            continue
        yield f"{name}: {described(found)}"
        for of in sorted({str(head["commit"]).removesuffix(DIRTY) for head in heads(found)}):
            command = [
                "git",
                "-C",
                str(ROOT),
                "rev-list",
                "--count",
                f"{of}..HEAD",
                "--",
                "model",
                "workers",
                "service",
            ]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            since = f"{done.stdout.strip()} commits changed the product" if done.returncode == 0 else "age not known"
            yield f"    {of}: {since} since"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("do", choices=("ready", "record", "show", "list", "check"))
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(TARGETS))
    given = parser.parse_args()
    try:
        if given.do == "ready" or (given.do == "record" and given.names):
            here = recordable_commit()
            for name, document in {name: to_record(name, here) for name in given.names}.items():
                write_whole(kept(name), json.dumps(document, indent=1, allow_nan=False) + "\n")
                if name == "confidence":
                    import confidence

                    confidence.draw(document)
    except NotRecordable as error:
        sys.exit(f"error: {error}")
    if given.do == "show":
        show(*given.names)
    if given.do == "list":
        sys.stdout.writelines(f"{line}\n" for line in listing())
    if given.do in ("record", "check"):
        for page in documents():
            text = page.read_text(encoding="utf-8")
            if (new := current(text)) != text:
                if given.do == "check":
                    sys.exit(
                        f"error: {page.relative_to(ROOT)} is not what the figures say: run benchmarks/figures.py record"
                    )
                write_whole(page, new)


if __name__ == "__main__":
    main()

"""Figures as they are measured: their files, the programs that measure run by run, and the tables that show them.

A file is JSON that begins with `measured`: commit, date, machine; or it holds runs by name, each of which begins so.
figures.py records what is left here in build/bench.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import logging
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch

from ultragray.files import write_whole
from ultragray_studies.bench.report import DIRTY, cell, measured

ROOT = Path(__file__).resolve().parents[1]
STAGE = ROOT / "build" / "bench"  # where targets of the Makefile measure into; git ignores it
SECONDS_PER_LINE = 15.0

Document = dict[str, Any]
Lines = Iterable[str]

log = logging.getLogger("figures")


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
    STAGE.mkdir(parents=True, exist_ok=True)
    write_whole(staged(name), json.dumps(document, indent=1, allow_nan=False) + "\n")


Run = Callable[[Path], Document]  # measures one run, given the folder of the data sets


def measure_runs(name: str, about: str | None, runs: Mapping[str, Run], *, threads: int = 0, at_once: int = 1) -> None:
    """The program of a file that is measured run by run: `DATA_FOLDER [--only NAME ...]`.

    A run's figures are written as soon as it is done, and it is not repeated at the same commit: a killed program goes
    on. `threads`: 0 for all cores. `at_once`: runs that are measured beside each other, by a program each; for figures
    that do not tell how busy the machine is.
    """
    parser = argparse.ArgumentParser(description=(about or "").partition("\n")[0])
    parser.add_argument("data_folder", type=Path, help="folder of the data sets")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="runs whose names begin so: " + ", ".join(runs))
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    if threads:
        torch.set_num_threads(threads)
    wanted = [run for run in runs if arguments.only is None or run.startswith(tuple(arguments.only))]
    if min(at_once, len(wanted)) > 1:
        program = [sys.executable, sys.argv[0], str(arguments.data_folder), "--only"]
        with ThreadPoolExecutor(at_once) as pool:
            list(pool.map(lambda run: subprocess.run([*program, run], check=True), wanted))
        return
    for run in wanted:
        head = measured(torch.get_num_threads())
        known = read(staged(name)).get(run)
        if known is not None and known["measured"]["commit"] == head["commit"] and not is_dirty(head):
            continue
        log.info("%s", run)
        figures = {**runs[run](arguments.data_folder), "measured": head}
        STAGE.mkdir(parents=True, exist_ok=True)
        with staged(name).with_suffix(".lock").open("w") as lock:  # another program may write what it has measured
            fcntl.flock(lock, fcntl.LOCK_EX)
            write(name, {**read(staged(name)), run: figures})


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
    facts = {name: machine.get(name) for name in ("model", "threads", "cores", "memory_gib")}
    threads = facts["threads"] and f"{facts['threads']} thread{'s'[: facts['threads'] != 1]}"
    parts = (
        machine["processor"] + (f" ({facts['model']})" if facts["model"] else ""),
        machine.get("instruction_set"),
        " on ".join(filter(None, (threads, facts["cores"] and f"{facts['cores']} cores"))),
        facts["memory_gib"] and f"{facts['memory_gib']:.0f} GiB",
    )
    return ", ".join(filter(None, parts))


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> Iterator[str]:
    """The lines of a table of Markdown."""
    names = list(head)
    yield f"| {' | '.join(names)} |"
    yield "|---" * len(names) + "|"
    for row in rows:
        yield f"| {' | '.join(row)} |"


def columns(rows: Iterable[Mapping[str, Any]], patterns: Mapping[str, str]) -> Iterator[str]:
    """A row for each of `rows`; a column is its head and the pattern of its cells, empty where a figure is None."""
    return table(patterns, ([cell(pattern, row) for pattern in patterns.values()] for row in rows))

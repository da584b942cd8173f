"""Writes measured figures into README.md and the documents: `python benchmarks/documents.py`.

    python benchmarks/documents.py --show bench    prints what build/bench holds of a target instead

Each place stands between `<!-- measured: NAME -->` and `<!-- end -->`; BLOCKS says what is written there. `make check`
fails where a document does not hold what the files say.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import ablations
import confidence
import localization
import methods_tables
import performance
import poses
import results_tables
from registry import FIGURES, ROOT, Document, described, heads
from scaling import tables
from ultragray.files import write_whole


def _everything(figures: Document) -> Document:
    return figures


@dataclass(frozen=True)
class Block:
    """What is written in one place: lines about a file of FIGURES, or about a part of its runs."""

    source: str
    lines: Callable[[Document], Iterable[str]]
    part: Callable[[Document], Document] = _everything

    def of(self, figures: Document) -> list[str]:
        """The lines, then where the figures come from."""
        part = self.part(figures)
        return [*self.lines(part), "", f"`{FIGURES[self.source].path}`: {described(heads(part))}."]


BLOCKS = {
    "frames": Block("results", performance.frames),
    "frames at a glance": Block("results", performance.frames_at_a_glance),
    "training steps": Block("training", performance.steps),
    "parts of a frame": Block("kernel", performance.parts),
    "clients": Block("clients", performance.clients),
    "control loop": Block("clients", performance.control_loop),
    "jobs": Block("jobs", performance.jobs),
    "shards": Block("shards", performance.shards),
    "console": Block("console", performance.console),
    "environment": Block("environment", performance.environment),
    "ros": Block("ros", performance.ros),
    "imports": Block("libraries", performance.imports),
    "beside scikit-image": Block("libraries", performance.beside_scikit_image),
    "shadows": Block("libraries", performance.shadows),
    "results": Block("results_tables", results_tables.tables),
    "results at a glance": Block("results_tables", results_tables.at_a_glance, results_tables.glanced_at),
    "methods": Block("methods_tables", methods_tables.tables),
    "ablations": Block("ablations", ablations.tables),
    "poses": Block("poses", poses.table),
    "localization": Block("localization", localization.table),
    "confidence": Block("confidence", confidence.tables),
    "simulated costs": Block("simulation", tables.costs),
    "simulation against theory": Block("simulation", tables.checks),
    "simulated defaults": Block("simulation", tables.defaults),
    **{f"simulated {name}": Block("simulation", tables.study(name)) for name in tables.STUDIES},
}
_PLACE = re.compile(r"(?<=<!-- measured: )([\w ,-]+?)( -->\n).*?(?=<!-- end -->)", flags=re.DOTALL)
Read: TypeAlias = Callable[[str], Any]  # a file of FIGURES by its name


def documents() -> list[Path]:
    """README.md and everything below docs/ that has a place for figures."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [page for page in pages if _PLACE.search(page.read_text(encoding="utf-8"))]


def kept(name: str) -> Document:
    """The figures under version control."""
    return dict(json.loads(FIGURES[name].kept.read_text(encoding="utf-8")))


def current(text: str, read: Read = kept) -> str:
    """A document with the figures as the files have them."""
    return _PLACE.sub(lambda place: f"{place[1]}{place[2]}{block(place[1], read)}", text)


def block(name: str, read: Read = kept) -> str:
    """What is written in one place."""
    one = BLOCKS[name]
    return "".join(f"{line}\n" for line in one.of(read(one.source)))


def write() -> None:
    """Rewrite the documents whose figures have changed."""
    for page in documents():
        text = page.read_text(encoding="utf-8")
        if (new := current(text)) != text:
            write_whole(page, new)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--show", metavar="TARGET", choices={file.target for file in FIGURES.values()})
    given = parser.parse_args()
    if given.show is None:
        write()
        return
    for name, one in BLOCKS.items():
        staged = FIGURES[one.source].staged
        if FIGURES[one.source].target == given.show and staged.exists():
            lines = one.of(json.loads(staged.read_text(encoding="utf-8")))
            sys.stdout.write("\n".join((f"# {name}", "", *lines, "", "")))


if __name__ == "__main__":
    main()

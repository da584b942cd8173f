"""Generates client/ultragray_client/sync from aio with unasync: `python client/generate.py`.

`transport.py` and `__init__.py` are written by hand in both folders.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path

import unasync

PACKAGE = Path(__file__).resolve().parent / "ultragray_client"
MODULES = ("client", "connection", "datasets", "jobs", "scenes", "stream")

_HEADER = "# Generated from aio/{name}.py by client/generate.py; change that file.\n"
_REPLACEMENTS = {
    "asyncio": "time",
    "aclosing": "closing",
}  # beyond those that unasync knows; asyncio.sleep alone is used
_KEYWORD = re.compile(r"\b(?:async|await) ")


def generate_sync(output_folder: Path) -> list[Path]:
    """Writes the modules for threads, and returns their paths."""
    texts = {name: (PACKAGE / "aio" / f"{name}.py").read_text() for name in MODULES}
    classes = {f"Async{found}": found for text in texts.values() for found in re.findall(r"class Async(\w+)", text)}
    with tempfile.TemporaryDirectory() as temporary:
        source = Path(temporary, "aio")
        source.mkdir()
        for name, text in texts.items():
            (source / f"{name}.py").write_text(text)
        rule = unasync.Rule("/aio/", "/sync/", additional_replacements={**_REPLACEMENTS, **classes})
        unasync.unasync_files([str(source / f"{name}.py") for name in MODULES], [rule])
        written = []
        for name in MODULES:
            target = output_folder / f"{name}.py"
            text = Path(temporary, "sync", target.name).read_text()
            target.write_text(_HEADER.format(name=name) + _KEYWORD.sub("", text))  # those left are in docstrings
            written.append(target)
    return formatted(written)


def formatted(paths: list[Path]) -> list[Path]:
    """The files, in the project's format."""
    configuration = ["--config", str(PACKAGE.parents[1] / "pyproject.toml"), "--quiet", *map(str, paths)]
    subprocess.run(
        [sys.executable, "-m", "ruff", "check", "--select=I", "--fix", *configuration],
        check=True,
    )
    subprocess.run([sys.executable, "-m", "ruff", "format", *configuration], check=True)
    return paths


if __name__ == "__main__":
    generate_sync(PACKAGE / "sync")

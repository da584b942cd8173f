"""docs/extending.md is true: a copy of the tree is extended as the page says, piece by piece, and tested.

A comment before a code block says where it goes: `<!-- file: PATH -->` is a new file, `<!-- in: PATH; after: LINE -->`
(or `before`) lines beside one that is there once.
"""

import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

import ultragray._cpu

from ..surroundings import ROOT

PAGE = ROOT / "docs" / "extending.md"
ROOTS = ("model", "workers", "service", "proto", "client", "ros", "studies")
MOST_FILES = {  # by hand, tests and what is generated apart
    "An output": 3,
    "A frame setting": 4,
    "A probe": 4,
    "A dataset format": 3,
    "A job kind": 4,
    "An exporter": 3,
    "A display setting": 3,
}
CONCERNED = (
    *("tests/proto", "tests/client/test_client_generated.py", "tests/documents/test_snapshots.py"),
    *("tests/service/test_settings_used.py", "tests/model/test_outputs.py", "tests/model/test_probe.py"),
)

_BLOCK = re.compile(r"<!-- (file|in): (\S+?)(?:; (before|after): (.*?))? -->\n```python\n(.*?)```\n", flags=re.DOTALL)
# Runs a module or a script from the copy, whatever is installed: an editable install finds its modules before the path.
_RUN = """
import runpy, sys
sys.meta_path[:] = [one for one in sys.meta_path if "editable" not in (getattr(one, "__module__", "") or "").lower()]
sys.path[:0] = {roots}
sys.argv = {arguments}
if sys.argv[0] == "-m":
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
else:
    runpy.run_path(sys.argv[0], run_name="__main__")
"""


@dataclass(frozen=True)
class Step:
    """A block of the page."""

    section: str
    path: str
    beside: str | None  # "before" or "after"; None: a new file
    line: str
    code: str

    def apply(self, tree):
        """Do what the page says to a tree."""
        target = tree / self.path
        if self.beside is None:
            assert not target.exists(), f"{self.path} is there already"
            assert target.parent.is_dir(), f"{self.path} has no folder"
            target.write_text(self.code, encoding="utf-8")
            return
        lines = target.read_text(encoding="utf-8").splitlines(keepends=True)
        places = [place for place, line in enumerate(lines) if line.rstrip("\n") == self.line]
        assert len(places) == 1, f"{self.path} has {len(places)} lines {self.line!r}"
        place = places[0] + (self.beside == "after")
        target.write_text("".join([*lines[:place], self.code, *lines[place:]]), encoding="utf-8")


def steps():
    found = []
    for section in re.split(r"^## ", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]:
        title, _, text = section.partition("\n")
        blocks = _BLOCK.findall(text)
        assert len(blocks) == text.count("```python"), f"a block of {title} does not say where it goes"
        found += [Step(title, path, beside or None, line, code) for _, path, beside, line, code in blocks]
    return found


STEPS = steps()


@pytest.mark.parametrize("section", MOST_FILES)
def test_an_addition_touches_few_files(section):
    touched = {step.path for step in STEPS if step.section == section}
    assert 1 <= len({path for path in touched if not path.startswith("tests/")}) <= MOST_FILES[section]
    assert any(path.startswith("tests/") for path in touched), "the section has no test"


def run(tree, *arguments):
    roots = [str(tree / root) for root in ROOTS]
    program = _RUN.format(roots=[str(tree), *roots], arguments=list(arguments))
    process = subprocess.run([sys.executable, "-c", program], cwd=tree, capture_output=True, text=True, check=False)
    assert process.returncode == 0, f"{' '.join(arguments)}:\n{process.stdout[-6000:]}{process.stderr[-4000:]}"


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """A copy of the tracked files, with the compiled kernel."""
    copy = tmp_path_factory.mktemp("copy")
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    for name in filter(None, listed.stdout.split("\0")):
        if (ROOT / name).is_file() and not name.startswith("shared/"):
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, copy / name)
    kernel = Path(ultragray._cpu.__file__)
    shutil.copy2(kernel, copy / "model" / "ultragray" / kernel.name)
    return copy


@pytest.mark.lengthy
def test_the_page_is_true(tree):
    for step in STEPS:
        step.apply(tree)
    own = [step.path for step in STEPS if step.beside is None and step.path.startswith("tests/")]
    for command in ("proto/generate.py", "client/generate.py"):
        run(tree, command)
    run(tree, "-m", "docs.generator.snapshots")
    run(tree, "-m", "ruff", "check", "--config", "pyproject.toml", *{step.path for step in STEPS})
    run(tree, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:randomly", *own, *CONCERNED)
    assert "optional double floor" in (tree / "proto/ultragray/v1/rendering.proto").read_text()
    assert "floor: float | None = None" in (tree / "client/ultragray_client/contract.py").read_text()
    assert "endocavity" in (tree / "web/openapi.json").read_text()

"""A checkout of their own for the scripts that measure, and a folder of data."""

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

from ultragray.datasets.released import write_released
from ultragray_studies.bench import report

from ..model.learn.conftest import make_tiny_dataset
from ..scripts import benchmark

COMMITTER = ("-c", "user.name=tests", "-c", "user.email=tests@example.org", "-c", "commit.gpgsign=false")


@dataclass(frozen=True)
class Repository:
    """A checkout with a first commit, which holds `model/code.py` and `.gitignore`."""

    path: Path

    def git(self, *words):
        command = ["git", *COMMITTER, "-C", str(self.path), *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    @property
    def commit(self):
        return self.git("rev-parse", "--short=12", "HEAD")


def adopt(monkeypatch, root):
    """Let the scripts take a folder for the root of their checkout."""
    for module in (benchmark("measuring"), report):
        monkeypatch.setattr(module, "ROOT", root)
    monkeypatch.setattr(benchmark("measuring"), "STAGE", root / "build" / "bench")


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """A repository that the scripts take for their own."""
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    made = Repository(tmp_path / "checkout")
    (made.path / "model").mkdir(parents=True)
    (made.path / "model/code.py").write_text("first")
    (made.path / ".gitignore").write_text("build")
    made.git("init", "--quiet")
    made.git("add", "--all")
    made.git("commit", "--quiet", "--message", "first")
    adopt(monkeypatch, made.path)
    return made


@pytest.fixture
def data(tmp_path):
    """A folder of data with one sweep in it, `ball`: six training and two held-out frames, 1 mm apart."""
    write_released(make_tiny_dataset(frames=8, height=16, width=14, spacing_mm=1.0), tmp_path / "ball")
    return tmp_path

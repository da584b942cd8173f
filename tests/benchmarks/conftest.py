"""A repository of its own for what asks git."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

from ..scripts import benchmark

COMMITTER = ("-c", "user.name=tests", "-c", "user.email=tests@example.org", "-c", "commit.gpgsign=false")


@dataclass(frozen=True)
class Repository:
    """A checkout with a first commit, which holds `model/code.py` and `README.md`."""

    path: Path

    def git(self, *words: str) -> str:
        command = ["git", *COMMITTER, "-C", str(self.path), *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    def commit(self, name: str, text: str) -> str:
        """Commits a file; returns the commit's name as the figures have it."""
        file = self.path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
        self.git("add", "--all")
        self.git("commit", "--quiet", "--message", f"{name}: {text}")
        return self.git("rev-parse", "--short=12", "HEAD")


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Repository:
    """A repository that the scripts take for their own."""
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    made = Repository(tmp_path / "checkout")
    made.path.mkdir()
    made.git("init", "--quiet")
    made.commit("README.md", "a table")
    made.commit("model/code.py", "first")
    adopt(monkeypatch, made.path)
    return made


def adopt(monkeypatch: pytest.MonkeyPatch, root: Path) -> None:
    """Let the scripts take a folder for the root of their checkout."""
    from ultragray_service.bench import measured

    for module in (benchmark("registry"), benchmark("age"), measured):
        monkeypatch.setattr(module, "ROOT", root)
    monkeypatch.setattr(benchmark("registry"), "STAGE", root / "build" / "bench")

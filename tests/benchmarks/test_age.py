"""How old figures are: counted where git can tell, and said where it cannot; never a failure."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from ..scripts import benchmark
from .conftest import Repository, adopt

age, registry = benchmark("age"), benchmark("registry")
FILE = registry.Figures("benchmarks/some.json", "bench", ("model", ":(exclude)model/other"))


def write_figures(root: Path, *commits: str) -> None:
    date, machine = "2030-01-02T03:04:05+00:00", {"processor": "Abacus", "threads": 2, "cores": 4}
    runs: dict[str, Any] = {
        str(place): {"measured": {"commit": commit, "date": date, "machine": machine}}
        for place, commit in enumerate(commits)
    }
    path = root / FILE.path
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(runs))


def test_commits_to_what_a_file_measures_are_counted(repository: Repository) -> None:
    first = repository.git("rev-parse", "HEAD")[:12]
    write_figures(repository.path, first)
    repository.commit("service/code.py", "not measured")
    repository.commit("model/other/code.py", "left out")
    fresh = age.age_of(FILE)
    assert fresh.origin == f"commit {first}, 2030-01-02, Abacus, 2 threads on 4 cores"
    assert fresh.since == ""
    repository.commit("model/code.py", "second")
    assert age.age_of(FILE).since == f"1 commit changed what it measures since {first}"
    third = repository.commit("model/code.py", "third")
    (repository.path / "model/code.py").write_text("fourth")
    write_figures(repository.path, first, third)
    assert age.age_of(FILE).since == f"2 commits changed what it measures since {first}; uncommitted changes"
    write_figures(repository.path, f"{third}-dirty")
    assert age.age_of(FILE).since.startswith(f"measured with uncommitted changes to {third}")


def test_a_shallow_clone_cannot_tell(
    repository: Repository, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    first = repository.git("rev-parse", "--short=12", "HEAD")
    repository.commit("model/code.py", "second")
    repository.git("clone", "--quiet", "--depth", "1", f"file://{repository.path}", str(tmp_path / "shallow"))
    adopt(monkeypatch, tmp_path / "shallow")
    write_figures(tmp_path / "shallow", first)
    assert age.age_of(FILE).since == "whether the code has changed is not known: the clone is shallow"
    monkeypatch.setattr("sys.argv", ["age.py", "--changed"])
    age.main()
    assert capsys.readouterr().out == (
        "warning: whether measured figures are current is not known: the clone is shallow\n"
    )


def test_a_commit_may_be_lost(repository: Repository) -> None:
    write_figures(repository.path, "0123456789ab")
    assert age.age_of(FILE).since == (
        "whether the code has changed is not known: commit 0123456789ab is not in this clone"
    )


@pytest.mark.parametrize("is_git_installed", [True, False])
def test_nor_can_a_folder_without_git(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_git_installed: bool) -> None:
    adopt(monkeypatch, tmp_path)
    if not is_git_installed:
        monkeypatch.setenv("PATH", str(tmp_path))
    write_figures(tmp_path, "abc")
    assert age.age_of(FILE).since == "whether the code has changed is not known: there is no git checkout here"


def test_it_lists_and_warns(
    repository: Repository, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    absent = registry.Figures("benchmarks/absent.json", "bench-cuda", ("model",))
    monkeypatch.setattr(age, "FIGURES", {"some": FILE, "absent": absent})
    first = repository.git("rev-parse", "--short=12", "HEAD")
    write_figures(repository.path, first)
    monkeypatch.setattr("sys.argv", ["age.py", "--changed"])
    age.main()
    assert capsys.readouterr().out == ""
    repository.commit("model/code.py", "second")
    age.main()
    changed = f"1 commit changed what it measures since {first}"
    assert capsys.readouterr().out == f"warning: benchmarks/some.json: {changed} (make bench RECORD=1)\n"
    monkeypatch.setattr("sys.argv", ["age.py"])
    age.main()
    assert capsys.readouterr().out == (
        f"benchmarks/some.json: commit {first}, 2030-01-02, Abacus, 2 threads on 4 cores\n"
        f"    {changed}\n"
        "benchmarks/absent.json: not measured yet\n"
    )

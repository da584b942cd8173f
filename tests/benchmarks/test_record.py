"""Recording: only of a commit, only figures of that commit, run by run where a file is measured so."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from ultragray_studies.bench import report as measured

from ..scripts import benchmark
from .conftest import Repository, adopt

record, registry = benchmark("record"), benchmark("registry")


def figures(commit: str | None, value: int) -> dict[str, Any]:
    return {"measured": {"commit": commit, "date": "", "machine": {}}, "value": value}


def write(path: Path, document: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document))


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    monkeypatch.setattr("sys.argv", ["record.py", *arguments])
    monkeypatch.setattr(record.documents, "write", lambda: None)
    record.main()


def test_changed_sources_are_refused_in_a_sentence(repository: Repository, monkeypatch: pytest.MonkeyPatch) -> None:
    run(monkeypatch, "--ready")
    for name in ("README.md", "docs/figures.md", "benchmarks/results.json", "tests/soak-run.json"):
        write(repository.path / name, {"written": "by recording"})
    run(monkeypatch, "--ready")
    assert record.recordable_commit() == repository.git("rev-parse", "--short=12", "HEAD")
    for name in ("model/new.py", "model/newer.py", "model/newest.py", "model/code.py"):
        write(repository.path / name, {})
    with pytest.raises(SystemExit, match=r"commit or stash these changes first: model/code.py, .* and 1 more$"):
        run(monkeypatch, "--ready")


def test_a_folder_that_is_no_checkout_is_refused(
    repository: Repository, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    adopt(monkeypatch, tmp_path)
    with pytest.raises(SystemExit, match="this is no checkout of git"):
        run(monkeypatch, "--ready")
    adopt(monkeypatch, repository.path / "model")  # installed below somebody else's checkout
    with pytest.raises(SystemExit, match="this is no checkout of git"):
        run(monkeypatch, "--ready")


def test_a_file_takes_the_place_of_the_former(repository: Repository, monkeypatch: pytest.MonkeyPatch) -> None:
    repository.commit(".gitignore", "build")
    here = measured.commit()
    results = registry.FIGURES["results"]
    write(results.kept, figures("before", 1))
    write(results.staged, figures("before", 2))
    with pytest.raises(SystemExit, match=f"has no figures of commit {here}; measure them with make bench"):
        run(monkeypatch, "results")
    write(results.staged, figures(f"{here}-dirty", 2))
    with pytest.raises(SystemExit, match="has no figures"):
        run(monkeypatch, "results")
    write(results.staged, {**figures(here, 2), "quick": True})
    with pytest.raises(SystemExit, match="is of a quick run; measure it whole with make bench"):
        run(monkeypatch, "results")
    assert json.loads(results.kept.read_text())["value"] == 1
    write(results.staged, figures(here, 2))
    run(monkeypatch, "results")
    assert json.loads(results.kept.read_text()) == figures(here, 2)


def test_all_or_nothing_is_recorded(repository: Repository, monkeypatch: pytest.MonkeyPatch) -> None:
    repository.commit(".gitignore", "build")
    write(registry.FIGURES["results"].staged, figures(measured.commit(), 2))
    with pytest.raises(SystemExit, match=r"kernel\.json has no figures"):
        run(monkeypatch, "results", "kernel")
    assert not registry.FIGURES["results"].kept.exists()


def test_runs_take_the_place_of_those_of_the_same_name(repository: Repository, monkeypatch: pytest.MonkeyPatch) -> None:
    repository.commit(".gitignore", "build")
    here = measured.commit()
    ablations = registry.FIGURES["ablations"]
    write(ablations.kept, {"liver": {"seed 0": figures("before", 1), "seed 1": figures("before", 1)}})
    write(
        ablations.staged,
        {"liver": {"seed 0": figures(here, 2), "seed 1": figures("older", 2)}, "spine": {"seed 0": figures(here, 2)}},
    )
    run(monkeypatch, "ablations")
    assert json.loads(ablations.kept.read_text()) == {
        "liver": {"seed 0": figures(here, 2), "seed 1": figures("before", 1)},
        "spine": {"seed 0": figures(here, 2)},
    }

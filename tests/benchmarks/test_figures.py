"""Figures are recorded only of a commit, run by run where a file is measured so; the documents hold what they say."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from ..scripts import benchmark
from .conftest import Repository, adopt

figures, measuring = benchmark("figures"), benchmark("measuring")


def of(commit: str | None, value: int) -> dict[str, Any]:
    return {"measured": {"commit": commit, "date": "", "machine": {"processor": "P"}}, "value": value}


def write(path: Path, document: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document))


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    monkeypatch.setattr("sys.argv", ["figures.py", *arguments])
    monkeypatch.setattr(figures, "documents", lambda: [])
    figures.main()


def test_changed_sources_are_refused_in_a_sentence(repository: Repository, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("README.md", "docs/figures.md", "benchmarks/results.json", "tests/soak-run.json"):
        write(repository.path / name, {"written": "by recording"})
    run(monkeypatch, "ready")
    for name in ("model/new.py", "model/newer.py", "model/newest.py", "model/code.py"):
        write(repository.path / name, {})
    with pytest.raises(SystemExit, match=r"commit or stash these changes first: model/code.py, .* and 1 more$"):
        run(monkeypatch, "ready")


def test_a_folder_that_is_no_checkout_is_refused(repository: Repository, monkeypatch: pytest.MonkeyPatch) -> None:
    adopt(monkeypatch, repository.path / "model")  # installed below somebody else's checkout
    with pytest.raises(SystemExit, match="this is no checkout of git"):
        run(monkeypatch, "ready")


def test_a_file_takes_the_place_of_the_former(repository: Repository, monkeypatch: pytest.MonkeyPatch) -> None:
    here, kept, staged = repository.commit, figures.kept("results"), figures.staged("results")
    write(kept, of("before", 1))
    for commit in ("before", f"{here}-dirty"):
        write(staged, of(commit, 2))
        with pytest.raises(SystemExit, match=f"has no figures of commit {here}; measure them with make bench"):
            run(monkeypatch, "record", "results")
    write(staged, {**of(here, 2), "quick": True})
    with pytest.raises(SystemExit, match="is of a quick run; measure it whole with make bench"):
        run(monkeypatch, "record", "results")
    write(staged, of(here, 2))
    with pytest.raises(SystemExit, match=r"kernel\.json has no figures"):
        run(monkeypatch, "record", "results", "kernel")
    assert json.loads(kept.read_text())["value"] == 1, "all or nothing"
    run(monkeypatch, "record", "results")
    assert json.loads(kept.read_text()) == of(here, 2)


def test_runs_take_the_place_of_those_of_the_same_name(repository: Repository, monkeypatch: pytest.MonkeyPatch) -> None:
    here = repository.commit
    write(figures.kept("ablations"), {"liver": of("before", 1), "spine": of("before", 1)})
    write(figures.staged("ablations"), {"liver": of(here, 2), "spine": of("older", 2), "phantom": of(here, 2)})
    run(monkeypatch, "record", "ablations")
    recorded = {"liver": of(here, 2), "spine": of("before", 1), "phantom": of(here, 2)}
    assert json.loads(figures.kept("ablations").read_text()) == recorded


def test_runs_are_kept_one_by_one_and_not_repeated_at_their_commit(
    repository: Repository, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    taken: list[str] = []

    def take(name: str, folder: Path) -> dict[str, Any]:
        taken.append(name)
        if name == "third":
            raise OSError("no room")
        return {"folder": str(folder)}

    runs = {name: lambda folder, name=name: take(name, folder) for name in ("first", "second", "third")}

    def measure(*arguments: str) -> None:
        monkeypatch.setattr("sys.argv", ["results_tables.py", str(tmp_path), *arguments])
        measuring.measure_runs("results_tables", "Runs.", runs)

    measure("--only", "second")
    with pytest.raises(OSError, match="no room"):
        measure()
    assert taken == ["second", "first", "third"]
    found = figures.read(figures.staged("results_tables"))
    assert {name: one["folder"] for name, one in found.items()} == dict.fromkeys(("second", "first"), str(tmp_path))
    assert found["first"]["measured"]["commit"] == repository.commit
    (repository.path / "model/code.py").write_text("second")
    measure("--only", "second")
    assert taken == ["second", "first", "third", "second"], "figures of changed sources are taken again"


def test_every_place_has_its_block_and_every_block_its_place() -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in figures.documents())
    assert {name for name in figures.BLOCKS if f"<!-- measured: {name} -->\n" not in text} == set()
    assert figures.current(text), "a place without a block is a KeyError"


def test_another_measurement_makes_another_document() -> None:
    def read(name: str) -> dict[str, Any]:
        found = copy.deepcopy(figures.read(figures.kept(name)))
        found["rows"][0]["step_ms"] = 12345.6
        found["measured"] |= {"commit": "abc", "date": "2030-01-02T00:00:00+00:00"}
        return dict(found)

    text = "<!-- measured: training steps -->\nold\n<!-- end -->\n"
    new = figures.current(text, read)
    assert "12345.6" in new
    assert "`benchmarks/training.json`: commit abc, 2030-01-02, " in new
    assert "old" not in new


def test_a_block_names_the_commits_of_what_it_shows() -> None:
    shown, hidden = of("abc", 1), of("def", 1)
    one = figures.Block("ablations", lambda found: list(found), lambda found: {"one": found["one"]})
    assert one.of({"one": shown, "two": hidden}) == ["one", "", "commit abc, , P."]

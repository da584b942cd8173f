"""Figures are recorded only of a commit, run by run where a file is measured so; the documents hold what they say."""

import json

import pytest

from ..scripts import benchmark

figures, measuring = benchmark("figures"), benchmark("measuring")


def of(commit, value):
    return {"measured": {"commit": commit, "date": "", "machine": {"processor": "P"}}, "value": value}


def write(path, document):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document))


def run(monkeypatch, *arguments):
    monkeypatch.setattr("sys.argv", ["figures.py", *arguments])
    monkeypatch.setattr(figures, "documents", lambda: [])
    figures.main()


def test_changed_sources_are_refused_in_a_sentence(repository, monkeypatch):
    for name in ("README.md", "docs/figures.md", "benchmarks/results.json", "tests/soak-run.json"):
        write(repository.path / name, {"written": "by recording"})
    run(monkeypatch, "ready")
    for name in ("model/new.py", "model/newer.py", "model/newest.py", "model/code.py"):
        write(repository.path / name, {})
    with pytest.raises(SystemExit, match=r"commit or stash these changes first: model/code.py, .* and 1 more$"):
        run(monkeypatch, "ready")


def test_a_file_takes_the_place_of_the_former(repository, monkeypatch):
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


def test_runs_take_the_place_of_those_of_the_same_name(repository, monkeypatch):
    here = repository.commit
    write(figures.kept("ablations"), {"liver": of("before", 1), "spine": of("before", 1)})
    write(figures.staged("ablations"), {"liver": of(here, 2), "spine": of("older", 2), "phantom": of(here, 2)})
    run(monkeypatch, "record", "ablations")
    recorded = {"liver": of(here, 2), "spine": of("before", 1), "phantom": of(here, 2)}
    assert json.loads(figures.kept("ablations").read_text()) == recorded


def test_runs_are_kept_one_by_one_and_not_repeated_at_their_commit(repository, monkeypatch, tmp_path):
    taken = []

    def take(name, folder):
        taken.append(name)
        if name == "third":
            raise OSError("no room")
        if name == "first":
            others = figures.read(figures.staged("results_tables"))
            measuring.write("results_tables", {**others, "of another program": {"measured": {}}})
        return {"folder": str(folder)}

    runs = {name: lambda folder, name=name: take(name, folder) for name in ("first", "second", "third")}

    def measure(*arguments):
        monkeypatch.setattr("sys.argv", ["results_tables.py", str(tmp_path), *arguments])
        measuring.measure_runs("results_tables", "Runs.", runs)

    measure("--only", "second")
    with pytest.raises(OSError, match="no room"):
        measure()
    assert taken == ["second", "first", "third"]
    found = figures.read(figures.staged("results_tables"))
    assert found.pop("of another program"), "measured meanwhile"
    assert {name: one["folder"] for name, one in found.items()} == dict.fromkeys(("second", "first"), str(tmp_path))
    assert found["first"]["measured"]["commit"] == repository.commit
    (repository.path / "model/code.py").write_text("second")
    measure("--only", "second")
    assert taken == ["second", "first", "third", "second"], "figures of changed sources are taken again"


def test_every_place_has_its_block_and_every_block_its_place():
    text = "".join(page.read_text(encoding="utf-8") for page in figures.documents())
    assert {name for name in figures.BLOCKS if f"<!-- measured: {name} -->\n" not in text} == set()
    assert figures.current(text), "a place without a block is a KeyError"


def test_a_place_whose_file_is_not_there_says_how_it_is_measured():
    text = figures.current("<!-- measured: policies -->\n<!-- end -->", lambda name: {})
    assert text == "<!-- measured: policies -->\nNot measured yet: `make policy RECORD=1`.\n<!-- end -->"

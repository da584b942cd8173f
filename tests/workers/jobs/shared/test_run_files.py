"""Copies of runs: of one moment, whole, and without what a process is writing."""

from __future__ import annotations

from pathlib import Path

from ultragray_workers.jobs.shared.run_files import copy_of, files_in, version_of

from ultragray_workers.jobs.files import CHECKPOINT_NAME, JOURNAL_NAME


def write_run(run: Path) -> None:
    (run / "scene").mkdir(parents=True)
    (run / CHECKPOINT_NAME).write_bytes(b"state")
    (run / "scene" / "model").write_bytes(b"model")
    (run / "scene" / JOURNAL_NAME).write_bytes(b"line")
    (run / "scene" / ".model.x1.tmp").write_bytes(b"half")


def test_a_copy_has_all_but_what_is_half_written(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    assert copy_of(tmp_path / "run", version_of(tmp_path / "run"), tmp_path / "copy")
    names = [CHECKPOINT_NAME, f"scene/{JOURNAL_NAME}", "scene/model"]
    assert list(files_in(tmp_path / "copy")) == names


def test_a_journal_alone_is_no_new_version(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    before = version_of(tmp_path / "run")
    (tmp_path / "run" / "scene" / JOURNAL_NAME).write_bytes(b"line\nline")
    assert version_of(tmp_path / "run") == before
    assert version_of(tmp_path / "nowhere") == {}


def test_a_run_that_changes_meanwhile_is_not_copied(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    before = version_of(tmp_path / "run")
    (tmp_path / "run" / "result").write_bytes(b"later")
    assert not copy_of(tmp_path / "run", before, tmp_path / "later")
    (tmp_path / "run" / CHECKPOINT_NAME).unlink()
    assert not copy_of(tmp_path / "run", before, tmp_path / "gone")


def test_a_copy_stays_as_it_is_when_a_file_is_replaced(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    assert copy_of(tmp_path / "run", version_of(tmp_path / "run"), tmp_path / "copy")
    new = tmp_path / "new"
    new.write_bytes(b"next state")
    new.replace(tmp_path / "run" / CHECKPOINT_NAME)
    assert (tmp_path / "copy" / CHECKPOINT_NAME).read_bytes() == b"state"

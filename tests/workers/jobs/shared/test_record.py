"""The record of a shared job belongs to one attempt: who was cut off changes nothing any more."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from ultragray_workers.jobs.shared.record import (
    JobRecord,
    LogPiece,
    StoredFile,
    Superseded,
    change,
    claim,
    read_record,
    record_key,
)

from ultragray_workers.jobs.folder import Outcome, Progress
from ultragray_workers.storage.local import LocalStorage
from ultragray_workers.storage.storage import Storage

JOB = "0123456789abcdef01234567"


@pytest.fixture
def storage(tmp_path: Path) -> Storage:
    return LocalStorage(tmp_path)


def test_a_record_survives_its_json() -> None:
    record = JobRecord(
        submission="first",
        attempt=2,
        writer="w",
        serial=7,
        progress=Progress(step=3, steps=20, loss=0.5),
        log=(LogPiece("a", 12),),
        run={"checkpoint.safetensors": StoredFile("b", 1, "c")},
        artifacts={"one.ugr": StoredFile("d", 2, "e")},
        outcome=Outcome(artifacts=("one.ugr",), metrics={"psnr_db": 30.0}),
    )
    assert JobRecord.from_json(record.to_json()) == record
    assert record.keys() == {"a", "b", "d"}


def test_the_successor_goes_on_and_its_predecessor_writes_nothing_any_more(storage: Storage) -> None:
    first = claim(storage, JOB, "s", 1)
    change(storage, JOB, first.writer, lambda before: replace(before, progress=Progress(step=5)))
    second = claim(storage, JOB, "s", 2)
    assert second.progress.step == 5
    with pytest.raises(Superseded):
        change(storage, JOB, first.writer, lambda before: replace(before, outcome=Outcome(error="INTERNAL")))
    with pytest.raises(Superseded):
        claim(storage, JOB, "s", 1)  # one that was stopped before it claimed the record
    after = change(storage, JOB, second.writer, lambda before: replace(before, outcome=Outcome()))
    assert read_record(storage, JOB) == after
    assert after.outcome is not None
    assert after.outcome.error is None


def test_a_successor_that_comes_between_look_and_write_wins(storage: Storage) -> None:
    first = claim(storage, JOB, "s", 1)

    def late(before: JobRecord) -> JobRecord:
        claim(storage, JOB, "s", 2)
        return replace(before, progress=Progress(step=9))

    with pytest.raises(Superseded):
        change(storage, JOB, first.writer, late)
    record = read_record(storage, JOB)
    assert record is not None
    assert (record.attempt, record.progress.step) == (2, None)


def test_another_submission_of_the_same_id_begins_anew(storage: Storage) -> None:
    first = claim(storage, JOB, "before the database was lost", 3)
    change(storage, JOB, first.writer, lambda before: replace(before, outcome=Outcome()))
    assert claim(storage, JOB, "after", 1).outcome is None


def test_a_record_that_was_removed_stays_removed(storage: Storage) -> None:
    first = claim(storage, JOB, "s", 1)
    storage.delete(record_key(JOB))
    with pytest.raises(Superseded):
        change(storage, JOB, first.writer, lambda before: before)
    assert storage.entry(record_key(JOB)) is None

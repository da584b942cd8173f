"""What a worker tells other hosts of its job: whole checkpoints, all of the log, and nothing once it was cut off."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from ultragray_workers.jobs.shared.files import SharedFiles
from ultragray_workers.jobs.shared.record import Superseded, read_record, record_key
from ultragray_workers.jobs.worker.sharing import ThroughStorage

from ultragray_workers.errors import StorageUnavailable
from ultragray_workers.jobs.files import CHECKPOINT_NAME, CONFIG_NAME, JOURNAL_NAME, SharedLog, opened
from ultragray_workers.jobs.folder import JobFolder, Outcome, Progress
from ultragray_workers.jobs.worker import sharing
from ultragray_workers.storage.local import LocalStorage

from ....waiting import wait_until

JOB, SUCCESSOR = "0" * 24, "1" * 24


class Unsteady(LocalStorage):
    """A storage that fails the next `failures` requests whose key has `part`."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.failures, self.part = 0, ""

    def upload(self, path: Path, key: str, **options: Any) -> bool:
        self._fail(key)
        return super().upload(path, key, **options)

    def write(self, key: str, data: bytes, **options: Any) -> bool:
        self._fail(key)
        return super().write(key, data, **options)

    def _fail(self, key: str) -> None:
        if self.failures and self.part in key:
            self.failures -= 1
            raise StorageUnavailable("it is away")


@pytest.fixture
def storage(tmp_path: Path) -> Unsteady:
    return Unsteady(tmp_path / "bucket")


@pytest.fixture
def attempt(tmp_path: Path, storage: Unsteady) -> Callable[..., tuple[ThroughStorage, JobFolder]]:
    """An attempt at the job by a worker of a host of its own, which has taken it over."""

    def make(number: int, *, job: str = JOB, **options: Any) -> tuple[ThroughStorage, JobFolder]:
        folder = JobFolder(tmp_path / f"host-{number}", job)
        values = {"submission": "s", "needed": None, "retry_of": None, "watch": lambda: None, **options}
        made = ThroughStorage(storage, folder, attempt=number, **values)
        made.take_over()
        return made, folder

    return make


Attempt = Callable[..., tuple[ThroughStorage, JobFolder]]


def write_run(folder: JobFolder, step: int) -> None:
    folder.run.mkdir(exist_ok=True)
    (folder.run / JOURNAL_NAME).write_text('{"step": 1}\n' * step)
    new = folder.run / "new"
    new.write_bytes(b"checkpoint of step %d" % step)
    new.replace(folder.run / CHECKPOINT_NAME)
    folder.write_progress(Progress(step=step))


def log_of(storage: Unsteady) -> bytes:
    log = SharedLog(storage, JOB)
    return log.read(0, log.size())


def test_a_successor_goes_on_from_the_checkpoint_and_its_log_follows(attempt: Attempt, storage: Unsteady) -> None:
    one, first = attempt(1)
    first.log.write_bytes(b"begun\n")
    write_run(first, 3)
    one.tell_last()
    two, second = attempt(2)
    assert (second.run / CHECKPOINT_NAME).read_bytes() == b"checkpoint of step 3"
    assert (second.run / JOURNAL_NAME).read_text().count("\n") == 3
    assert second.progress().step == 3
    second.log.write_bytes(b"going on\n")
    write_run(second, 5)
    two.tell_last()
    assert log_of(storage) == b"begun\ngoing on\n"
    with SharedFiles(storage, second.path).checkpoint(JOB) as newest:
        assert newest is not None
        assert newest[0].read_bytes() == b"checkpoint of step 5"
    assert sum(entry.key.endswith(CHECKPOINT_NAME) for entry in storage.entries()) == 1  # the newest only


def test_who_was_cut_off_changes_nothing_any_more(attempt: Attempt, storage: Unsteady) -> None:
    one, first = attempt(1)
    two, _ = attempt(2)
    write_run(first, 9)
    first.log.write_bytes(b"still here\n")
    one.tell_last()
    with pytest.raises(Superseded):
        one.end(Outcome(error="INTERNAL", reason="late"))
    two.end(Outcome(metrics={"psnr_db": 1.0}))
    with pytest.raises(Superseded):
        one.end(Outcome(error="INTERNAL", reason="later"))
    record = read_record(storage, JOB)
    assert record is not None
    assert (record.attempt, record.outcome, log_of(storage)) == (2, Outcome(metrics={"psnr_db": 1.0}), b"")


def test_a_checkpoint_that_was_half_told_is_none(attempt: Attempt, storage: Unsteady) -> None:
    one, first = attempt(1)
    write_run(first, 3)
    one.tell_last()
    write_run(first, 6)
    storage.failures, storage.part = 1, JOURNAL_NAME
    one.tell_last()
    _, second = attempt(2)
    assert (second.run / CHECKPOINT_NAME).read_bytes() == b"checkpoint of step 3"


def test_an_end_waits_for_a_storage_that_is_away(
    attempt: Attempt, storage: Unsteady, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sharing, "_RETRY_S", 0.05)
    monkeypatch.setattr(sharing, "_LOOK_S", 0.02)
    looks: list[int] = []
    one, first = attempt(1, watch=lambda: looks.append(storage.failures))
    with first.new_artifacts() as made:
        (made / "frames.npz").write_bytes(bytes(range(256)))
    storage.failures = 4
    one.end(Outcome(artifacts=("frames.npz",)))
    assert {4, 1} & set(looks)
    found = SharedFiles(storage, first.path).artifacts(JOB)
    with opened(found["frames.npz"]) as file:
        assert (file.length, file.read(250, 100)) == (256, bytes(range(250, 256)))


def test_a_caller_that_is_told_to_stop_does_not_wait(
    attempt: Attempt, storage: Unsteady, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sharing, "_RETRY_S", 0.05)
    one, _ = attempt(1)

    def stop() -> None:
        raise InterruptedError

    storage.failures = 1000
    monkeypatch.setattr(one, "_watch", stop)
    with pytest.raises(InterruptedError):
        one.end(Outcome())


def test_a_long_log_is_told_in_pieces_and_read_from_anywhere(
    attempt: Attempt, storage: Unsteady, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sharing, "PIECE_BYTES", 100)
    monkeypatch.setattr(sharing, "MOST_LOG_BYTES", 250)
    one, first = attempt(1)
    said = b"".join(b"line %03d\n" % number for number in range(60))
    with first.log.open("ab") as log:
        for begin in range(0, len(said), 77):
            log.write(said[begin : begin + 77])
            log.flush()
            one.tell_last()
    one.end(Outcome())
    assert log_of(storage) == said
    assert SharedLog(storage, JOB).read(95, 130) == said[95:225]
    assert SharedLog(storage, JOB).read(len(said) + 5, 10) == b""


def test_a_success_leaves_what_it_names_and_the_scene_it_was_given(attempt: Attempt, storage: Unsteady) -> None:
    one, first = attempt(1)
    storage.write(f"jobs/{JOB}/demo.ugr", b"kept for the job")
    write_run(first, 3)
    one.tell_last()
    two, second = attempt(2)
    with second.new_artifacts() as made:
        (made / "one.ugr").write_bytes(b"made")
    two.end(Outcome(artifacts=("one.ugr",), progress=Progress(step=4)))
    record = read_record(storage, JOB)
    assert record is not None
    assert record.run == {}
    assert {entry.key for entry in storage.entries()} == record.keys() | {record_key(JOB), f"jobs/{JOB}/demo.ugr"}
    _, third = attempt(3)  # the worker died before the queue knew
    assert third.outcome() == Outcome(artifacts=("one.ugr",), progress=Progress(step=4))
    assert (third.artifacts / "one.ugr").read_bytes() == b"made"


@pytest.mark.parametrize(("error", "goes_on"), [("JOB_STALLED", True), ("TRAINING_STATE_INVALID", False)])
def test_a_retry_goes_on_from_the_checkpoint_of_its_predecessor(attempt: Attempt, error: str, goes_on: bool) -> None:
    one, first = attempt(1)
    write_run(first, 7)
    one.end(Outcome(error=error, reason="it failed"))
    _, second = attempt(2, job=SUCCESSOR, retry_of=JOB)
    assert (second.run / CHECKPOINT_NAME).exists() is goes_on


def test_what_changes_is_told_meanwhile(
    attempt: Attempt, storage: Unsteady, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sharing, "TELL_INTERVAL_S", 0.05)
    one, first = attempt(1)
    files = SharedFiles(storage, tmp_path)
    with one.telling():
        write_run(first, 2)
        wait_until(lambda: files.progress(JOB).step == 2)
        wait_until(lambda: (files.text_of_run(JOB, JOURNAL_NAME) or "").count("\n") == 2)
        storage.failures = 3  # a while away: what was missed is told later
        write_run(first, 4)
        wait_until(lambda: files.progress(JOB).step == 4)


def test_a_job_that_was_removed_is_not_brought_back(attempt: Attempt, storage: Unsteady, tmp_path: Path) -> None:
    one, first = attempt(1)
    write_run(first, 2)
    with SharedFiles(storage, tmp_path).removed(JOB):
        pass
    one.tell_last()
    assert storage.entry(record_key(JOB)) is None


def test_a_run_of_many_folders_goes_along_and_what_did_not_change_is_told_once(
    attempt: Attempt, storage: Unsteady
) -> None:
    first, folder = attempt(1)
    (folder.run / "scene").mkdir(parents=True)
    (folder.run / "scene" / "model").write_bytes(b"learned")
    (folder.run / "scene" / CONFIG_NAME).write_bytes(b"settings")
    first.tell_last()
    before = read_record(storage, JOB)
    (folder.run / "tri" / "fit").parent.mkdir()
    (folder.run / "tri" / "fit").write_bytes(b"step 3")
    first._tell(is_last=True)
    after = read_record(storage, JOB)
    assert before is not None
    assert after is not None
    assert set(after.run) == {"scene/model", f"scene/{CONFIG_NAME}", "tri/fit"}
    assert after.run["scene/model"] == before.run["scene/model"]
    _, successor = attempt(2)
    assert (successor.run / "scene" / "model").read_bytes() == b"learned"
    assert (successor.run / "scene" / CONFIG_NAME).read_bytes() == b"settings"
    assert (successor.run / "tri" / "fit").read_bytes() == b"step 3"

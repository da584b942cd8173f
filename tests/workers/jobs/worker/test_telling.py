"""What a worker tells others of its job: whole checkpoints, all of the log, and nothing once it was cut off."""

import pytest

from ultragray_workers.errors import StorageUnavailable
from ultragray_workers.jobs import queue
from ultragray_workers.jobs.files import CHECKPOINT_NAME, CONFIG_NAME, JOURNAL_NAME
from ultragray_workers.jobs.folder import JobFolder
from ultragray_workers.jobs.progress import Outcome, Progress
from ultragray_workers.jobs.record import Row
from ultragray_workers.jobs.worker import telling
from ultragray_workers.jobs.worker.telling import Telling
from ultragray_workers.storage.local import LocalStorage

from ....waiting import wait_until
from ..conftest import request_of, train_job


class Unsteady(LocalStorage):
    """A storage that fails the next `failures` requests whose key has `part`."""

    failures, part = 0, ""

    def upload(self, path, key, **options):
        self._fail(key)
        return super().upload(path, key, **options)

    def write(self, key, data, **options):
        self._fail(key)
        return super().write(key, data, **options)

    def _fail(self, key):
        if self.failures and self.part in key:
            self.failures -= 1
            raise StorageUnavailable("it is away")


class Attempt:
    """An attempt at a job by a worker of a host of its own, which has taken it over."""

    def __init__(self, jobs, storage, host, watch):
        self._engine = jobs.engine
        row = queue.take(jobs.engine, host.name, queue.demands_waiting(jobs.engine))
        self.row: Row = row
        self.folder = JobFolder(host, row.id, row.attempt)
        self.telling = Telling(jobs, storage, self.folder, row, watch)
        self.telling.take_over()

    def write_run(self, step):
        run = self.folder.run
        run.mkdir(exist_ok=True)
        (run / JOURNAL_NAME).write_text('{"step": 1}\n' * step)
        (run / "new").write_bytes(b"checkpoint of step %d" % step)
        (run / "new").replace(run / CHECKPOINT_NAME)
        self.folder.write_progress(Progress(step=step))

    def give_up(self):
        """Its worker tells the last of the job, which waits again."""
        self.telling.tell_last()
        queue.put_back(self._engine, self.row)

    def end(self, outcome):
        return queue.finish(self._engine, self.row, outcome, self.telling.end(outcome))


@pytest.fixture
def storage(artifact_folder):
    return Unsteady(artifact_folder)


@pytest.fixture
def attempt(jobs, storage, tmp_path):
    hosts = iter(range(100))
    return lambda watch=lambda: None: Attempt(jobs, storage, tmp_path / f"host-{next(hosts)}", watch)


@pytest.fixture
def job(store):
    return store.submit(train_job("one"))[0]


@pytest.fixture
def files(store):
    return store.files


def checkpoint_of(attempt):
    return (attempt.folder.run / CHECKPOINT_NAME).read_bytes()


def test_a_successor_goes_on_from_the_checkpoint_and_its_log_follows(attempt, job, store, storage):
    one = attempt()
    one.folder.log.write_bytes(b"begun\n")
    one.write_run(3)
    one.give_up()
    two = attempt()
    assert checkpoint_of(two) == b"checkpoint of step 3"
    assert (two.folder.run / JOURNAL_NAME).read_text().count("\n") == 3
    assert two.folder.progress().step == 3
    two.folder.log.write_bytes(b"going on\n")
    two.write_run(5)
    two.telling.tell_last()
    assert store.log_tail(job.id) == "begun\ngoing on\n"
    with store.files.checkpoint(job.id) as newest:
        assert newest[0].read_bytes() == b"checkpoint of step 5"


def test_who_was_cut_off_changes_nothing_any_more(attempt, jobs, job, store):
    one = attempt()
    queue.put_back(jobs.engine, one.row)
    two = attempt()
    one.write_run(9)
    one.folder.log.write_bytes(b"still here\n")
    one.telling.tell_last()
    assert not one.end(Outcome(error="INTERNAL", reason="late"))
    assert two.end(Outcome(metrics={"psnr_db": 1.0}))
    assert (store.get(job.id).metrics, store.log_tail(job.id)) == ({"psnr_db": 1.0}, "")


def test_a_checkpoint_that_was_half_told_is_none(attempt, jobs, job, storage):
    one = attempt()
    one.write_run(3)
    one.telling._tell(is_last=True)
    one.write_run(6)
    storage.failures, storage.part = 1, "run-2"
    one.give_up()
    assert checkpoint_of(attempt()) == b"checkpoint of step 3"


def test_an_end_waits_for_a_storage_that_is_away(attempt, job, files, storage, monkeypatch):
    monkeypatch.setattr(telling, "_RETRY_S", 0.05)
    monkeypatch.setattr(telling, "_LOOK_S", 0.02)
    looks = []
    one = attempt(lambda: looks.append(storage.failures))
    with one.folder.new_artifacts() as made:
        (made / "frames.npz").write_bytes(bytes(range(256)))
    storage.failures = 4
    assert one.end(Outcome(artifacts=("frames.npz",)))
    assert {3, 2, 1} & set(looks)
    found = files.artifacts(job.id)["frames.npz"]
    assert (found.stored.bytes, found.read(250, 100)) == (256, bytes(range(250, 256)))


def test_a_caller_that_is_told_to_stop_does_not_wait(attempt, job, storage, monkeypatch):
    one = attempt()
    one.folder.log.write_bytes(b"begun\n")

    def stop():
        raise InterruptedError

    storage.failures = 1000
    monkeypatch.setattr(one.telling, "_watch", stop)
    with pytest.raises(InterruptedError):
        one.telling.end(Outcome())


def test_a_long_log_is_told_in_pieces_and_read_from_anywhere(attempt, job, files, monkeypatch):
    monkeypatch.setattr(telling, "PIECE_BYTES", 100)
    monkeypatch.setattr(telling, "MOST_BYTES", 250)
    one = attempt()
    said = b"".join(b"line %03d\n" % number for number in range(60))
    with one.folder.log.open("ab") as log:
        for begin in range(0, len(said), 77):
            log.write(said[begin : begin + 77])
            log.flush()
            one.telling._tell(is_last=False)
    assert one.end(Outcome())
    found = files.log(job.id)
    assert found.read(0, found.size()) == said
    assert found.read(95, 130) == said[95:225]
    assert found.read(len(said) + 5, 10) == b""


def test_a_success_leaves_what_it_names_and_the_scene_it_was_given(attempt, jobs, job, storage):
    one = attempt()
    storage.write(f"jobs/{job.id}/demo.ugr", b"kept for the job")
    one.write_run(3)
    one.give_up()
    two = attempt()
    with two.folder.new_artifacts() as made:
        (made / "one.ugr").write_bytes(b"made")
    assert two.end(Outcome(artifacts=("one.ugr",), progress=Progress(step=4)))
    two.telling.remove_others()
    row = queue.row_of(jobs.engine, job.id)
    assert row.files.run == {}
    assert {entry.key for entry in storage.entries("jobs")} == row.files.keys() | {f"jobs/{job.id}/demo.ugr"}


@pytest.mark.parametrize(("error", "goes_on"), [("JOB_STALLED", True), ("TRAINING_STATE_INVALID", False)])
def test_a_retry_goes_on_from_the_checkpoint_of_its_predecessor(attempt, job, store, error, goes_on):
    one = attempt()
    one.write_run(7)
    assert one.end(Outcome(error=error, reason="it failed"))
    store.retry(job.id)
    assert (attempt().folder.run / CHECKPOINT_NAME).exists() is goes_on


def test_what_changes_is_told_meanwhile(attempt, job, store, storage, monkeypatch):
    monkeypatch.setattr(telling, "TELL_INTERVAL_S", 0.05)
    one = attempt()
    with one.telling.telling():
        one.write_run(2)
        wait_until(lambda: store.get(job.id).progress.step == 2)
        wait_until(lambda: store.files.journal(job.id).count("\n") == 2)
        storage.failures = 3  # a while away: what was missed is told later
        one.write_run(4)
        wait_until(lambda: store.get(job.id).progress.step == 4)


def test_a_job_that_was_removed_is_not_brought_back(attempt, jobs, job, store):
    one = attempt()
    one.write_run(2)
    store.cancel(job.id)
    store.delete(job.id)
    one.telling.tell_last()
    assert queue.row_of(jobs.engine, job.id) is None


def test_a_run_of_many_folders_goes_along_and_what_did_not_change_is_told_once(attempt, jobs, job):
    one = attempt()
    run = one.folder.run
    (run / "scene").mkdir(parents=True)
    (run / "scene" / "model").write_bytes(b"learned")
    (run / "scene" / CONFIG_NAME).write_bytes(b"settings")
    one.telling._tell(is_last=True)
    before = queue.row_of(jobs.engine, job.id)
    (run / "tri" / "fit").parent.mkdir()
    (run / "tri" / "fit").write_bytes(b"step 3")
    one.telling._tell(is_last=True)
    after = queue.row_of(jobs.engine, job.id)
    assert set(after.files.run) == {"scene/model", f"scene/{CONFIG_NAME}", "tri/fit"}
    assert after.files.run["scene/model"] == before.files.run["scene/model"]
    one.give_up()
    two = attempt()
    assert (two.folder.run / "scene" / "model").read_bytes() == b"learned"
    assert (two.folder.run / "tri" / "fit").read_bytes() == b"step 3"


def test_a_worker_of_the_same_host_goes_on_where_the_dead_one_was(jobs, job, store, storage, tmp_path):
    """What was not told yet is not lost: the folder goes to the next attempt, and the log has each line once."""
    one = Attempt(jobs, storage, tmp_path / "host", lambda: None)
    one.folder.log.write_bytes(b"told\n")
    one.telling._tell(is_last=True)
    one.folder.log.write_bytes(b"told\nnot told\n")
    one.write_run(6)
    one.folder.write_request(request_of({}, tmp_path, one.row.number))
    queue.put_back_of(jobs.engine)
    two = Attempt(jobs, storage, tmp_path / "host", lambda: None)
    assert checkpoint_of(two) == b"checkpoint of step 6"
    with two.folder.log.open("ab") as log:
        log.write(b"going on\n")
    two.telling.tell_last()
    assert store.log_tail(job.id) == "told\nnot told\ngoing on\n"
    assert [path.name for path in (tmp_path / "host" / "work").iterdir()] == [f"{job.id}.2"]

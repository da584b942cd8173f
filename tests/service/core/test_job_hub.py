import asyncio
from dataclasses import replace

import pytest

from ultragray_service.core import jobs as job_hub
from ultragray_service.core.jobs import TAIL_BYTES, GrowingLog, JobChange, JobHub
from ultragray_workers.errors import JobNotFound
from ultragray_workers.jobs.progress import JobState, Progress
from ultragray_workers.jobs.record import Job

INTERVAL_S = 0.02
WAIT_S = 300.0


@pytest.fixture(autouse=True)
def _short_interval(monkeypatch):
    monkeypatch.setattr(job_hub, "READ_INTERVAL_S", INTERVAL_S)


class FileLog:
    """A log that is a file."""

    def __init__(self, path):
        self._path = path

    def size(self):
        return self._path.stat().st_size if self._path.exists() else 0

    def read(self, start, length):
        return self._path.read_bytes()[start : start + length] if self._path.exists() else b""


class OneJob:
    """A job that is changed by hand; counts how often it is read."""

    def __init__(self, folder):
        self.log_path = folder / "log.txt"
        self.reads = 0
        self.error = None
        self.job = Job(
            id="one",
            kind="train",
            state=JobState.RUNNING,
            request_id=None,
            specification={},
            priority=0,
            created_at="2026-01-01T00:00:00+00:00",
            started_at=None,
            finished_at=None,
            reason=None,
            error=None,
            progress=Progress(),
            artifacts=(),
            metrics={},
            worker=None,
            retry_of=None,
            attempts=1,
            owner=None,
            private=False,
        )
        self.hub = JobHub(self.get, lambda job_id: FileLog(self.log_path))

    def get(self, job_id):
        self.reads += 1
        if job_id != "one":
            raise JobNotFound(f"there is no job {job_id!r}")
        if self.error is not None:
            raise self.error
        return self.job

    def move(self, **changes):
        self.job = replace(self.job, **changes)


@pytest.fixture
def one(tmp_path):
    return OneJob(tmp_path)


async def change(watch):
    found = await watch.next(WAIT_S)
    assert found is not None
    return found


async def test_many_watchers_cost_as_many_reads_as_one(one):
    watches = [await one.hub.watch("one") for _ in range(50)]
    for watch in watches:
        assert (await change(watch)).job == one.job
    before = one.reads
    await asyncio.gather(*(watch.next(10 * INTERVAL_S) for watch in watches))
    assert one.reads - before <= 11
    one.move(progress=Progress(step=3))
    for found in await asyncio.gather(*map(change, watches)):
        assert found.job == one.job


async def test_a_watch_ends_after_the_final_state_and_the_last_line(one):
    one.log_path.write_text("begin\n")
    watch = await one.hub.watch("one")
    assert await change(watch) == JobChange(one.job, "begin\n", 6)
    assert not watch.finished
    one.log_path.write_text("begin\nend\n")
    one.move(state=JobState.SUCCEEDED)
    told = [await change(watch)]
    if told[0].job is None:  # the line was read before the state
        told.append(await change(watch))
    assert "".join(part.log for part in told) == "end\n"
    assert told[-1].job == one.job
    assert watch.finished
    assert await watch.next(WAIT_S) is None
    late = await one.hub.watch("one")
    assert await change(late) == JobChange(one.job, "begin\nend\n", 10)
    assert await late.next(WAIT_S) is None


async def test_a_watcher_who_reads_slowly_gets_the_newest_state(one):
    watch = await one.hub.watch("one")
    await change(watch)
    for step in range(5):
        one.move(progress=Progress(step=step))
    found = await change(watch)
    assert found.job.progress.step == 4
    assert await watch.next(2 * INTERVAL_S) == JobChange(None, "", 0)


async def test_an_unknown_job_and_one_that_cannot_be_read_any_more(one):
    with pytest.raises(JobNotFound):
        await one.hub.watch("two")
    watch = await one.hub.watch("one")
    await change(watch)
    one.error = OSError("the database has gone")
    with pytest.raises(OSError, match="gone"):
        await watch.next(WAIT_S)


async def test_a_closed_hub_ends_every_watch(one):
    watch = await one.hub.watch("one")
    await change(watch)
    one.hub.closing.set()
    assert await watch.next(WAIT_S) is None
    assert not watch.finished
    late = await one.hub.watch("one")
    assert await late.next(WAIT_S) is None


def test_a_log_is_told_in_whole_lines(tmp_path):
    path = tmp_path / "log.txt"
    log = GrowingLog(FileLog(path))
    assert log.read() == ""
    with path.open("a") as file:
        for text, expected in (("one\ntw", "one\n"), ("o", ""), ("\nthree\n", "two\nthree\n"), ("", "")):
            file.write(text)
            file.flush()
            assert log.read() == expected
    path.write_text("anew\n")
    assert log.read() == "anew\n"


def test_a_long_log_is_told_from_its_end_and_then_whole(tmp_path):
    path = tmp_path / "log.txt"
    lines = [f"line {number:06d}" for number in range(20_000)]
    path.write_text("\n".join(lines) + "\n")
    log = GrowingLog(FileLog(path))
    told = log.read()
    assert 0 < len(told) <= TAIL_BYTES
    assert told.splitlines() == lines[-len(told.splitlines()) :]
    assert (log.read(), log.has_more) == ("", False)
    with path.open("a") as file:
        file.write("\n".join(lines) + "\n")
    assert read_whole(log).splitlines() == lines
    assert log.offset == path.stat().st_size


def test_a_log_is_told_from_a_given_byte_and_a_line_without_end_in_pieces(tmp_path):
    path = tmp_path / "log.txt"
    path.write_text("told before\n" + "x" * 200_000 + "\nafter\n")
    log = GrowingLog(FileLog(path), len("told before\n"))
    assert read_whole(log) == "x" * 200_000 + "\nafter\n"


async def test_the_final_state_comes_with_the_last_lines_of_a_long_log(one):
    lines = "".join(f"line {number:06d}\n" for number in range(20_000))
    one.log_path.write_text(lines)
    one.move(state=JobState.SUCCEEDED)
    watch = await one.hub.watch("one", 0)
    told = []
    while (found := await watch.next(WAIT_S)) is not None:
        told.append(found)
    assert "".join(part.log for part in told) == lines
    assert [part.job for part in told] == [None] * (len(told) - 1) + [one.job]


def read_whole(log):
    told = log.read()
    while log.has_more:
        told += log.read()
    return told

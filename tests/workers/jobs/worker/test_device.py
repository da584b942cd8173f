"""One job at a time on a device, whoever works for the host; who waits for a device leaves the jobs to others."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from ultragray.installation import memory_bytes
from ultragray_workers.errors import StartupFailed
from ultragray_workers.jobs.demand import WorkerDevice
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.worker.device import DeviceLock, HostDevice, devices_of, lock_path
from ultragray_workers.jobs.worker.process import holder_of

from ....waiting import wait_until
from ..conftest import is_training, train_job


def device(name, lock_name):
    return HostDevice(WorkerDevice(name=name, model="a model", memory_bytes=8 * 10**9), lock_name)


CPU = device("cpu", "cpu")


@pytest.fixture
def database_url(request):
    if getattr(request, "param", "sqlite") == "sqlite":
        return None
    server = request.getfixturevalue("postgres")
    return server.create_database()


def test_lock_is_of_one_worker_until_both_it_and_its_process_let_go(tmp_path):
    mine, other = DeviceLock(tmp_path, CPU, "mine"), DeviceLock(tmp_path, CPU, "other")
    assert mine.take()
    assert mine.take()
    assert not other.take()
    holder = holder_of(mine.path)
    assert holder[1] == "mine"
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE, pass_fds=[mine.fileno()])
    mine.release()
    assert not other.take()
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert other.take()
    other.release()


def test_every_device_has_a_lock_of_its_own(tmp_path):
    assert [one.lock_name for one in devices_of("cpu")] == ["cpu"]
    devices = [CPU, device("cuda:0", "gpu-1"), device("cuda:1", "gpu-2")]
    assert len({lock_path(tmp_path, one) for one in devices}) == 3


def test_the_processor_is_offered_with_the_cores_and_the_memory_of_the_host():
    (processor,) = devices_of("cpu")
    assert processor.offered.name == "cpu"
    assert processor.offered.cores == len(os.sched_getaffinity(0))
    assert processor.offered.memory_bytes == memory_bytes()


@pytest.mark.parametrize("asked", ["cuda:99", "tpu"])
def test_a_worker_does_not_start_for_a_device_that_its_host_does_not_have(asked):
    with pytest.raises(StartupFailed, match=r"device must be .*got '(cuda:99|tpu)'") as caught:
        devices_of(asked)
    assert caught.value.field == "device"


@pytest.mark.long
@pytest.mark.parametrize("database_url", ["postgresql"], indirect=True)
def test_a_worker_that_comes_back_after_its_job_was_taken_over_leaves_it_alone(store, start_worker, until):
    """A worker of another host, which nobody can end; its process has gone on all the time.

    A SQLite file might be locked by who is stopped, until that one goes on.
    """
    one = start_worker("one", host="elsewhere")
    job, _ = store.submit(train_job("one", steps=20_000))
    until(job, is_training)
    process = one.job_process()
    assert process is not None
    one.suspend()
    two = start_worker("two")
    job = until(job, lambda job: job.worker == "two" and is_training(job))
    # Of this host in truth, where two processes of one folder never are. Its stopped parent has not seen its end.
    wait_until(lambda: "State:\tZ" in Path(f"/proc/{process}/status").read_text())
    successor = wait_until(two.job_process)
    until(job, is_training)
    one.process.send_signal(signal.SIGCONT)
    other, _ = store.submit(train_job("other"))
    other = until(other)  # it is at work again
    assert (other.state, other.worker) == (JobState.SUCCEEDED, "one"), other
    assert (two.job_process(), store.get(job.id).worker, store.get(job.id).attempts) == (successor, "two", 2)
    store.cancel(job.id)
    wait_until(lambda: two.job_process() is None)

"""Jobs go only to workers that fit them, past those ahead of them in the queue, as soon as such a worker comes."""

from dataclasses import replace

import pytest

from ultragray.installation import memory_bytes
from ultragray_workers.jobs.demand import Demand, WorkerDevice
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.queue import demands_waiting
from ultragray_workers.jobs.worker.device import DeviceLock, Gate, HostDevice

from ....waiting import wait_until
from ..conftest import train_job


@pytest.fixture
def database_url(new_database):
    return new_database()


def submit(store, scene, *, device="cpu", memory_gb=None, **labels):
    asked = {"device": device, "min_memory_gb": memory_gb, "worker_labels": labels}
    return store.submit(replace(train_job(scene), **asked))[0]


def is_there(store, worker):
    return lambda: worker in {one.name for one in store.workers()}


@pytest.mark.long
def test_a_job_that_nobody_can_take_says_so_and_starts_when_a_fitting_worker_comes(store, start_worker, until):
    job = submit(store, "made", site="lab2")
    asked = "a worker with the device cpu and the label site=lab2"
    assert job.progress.waits_for == f"{asked}: none is running"
    assert store.overview().unfit == 1
    running = start_worker("first", labels={"site": "lab1"})
    wait_until(is_there(store, "first"))
    memory = f"{memory_bytes() / 10**9:.0f}"
    expected = f"{asked}; there is first (cpu of {memory} GB, site=lab1)"
    assert store.get(job.id).progress.waits_for == expected
    listed, _ = store.list()
    assert [one.progress.waits_for for one in listed] == [expected]
    assert submit(store, "other", site="lab1").progress.waits_for is None
    overview = store.overview()
    assert overview.unfit == 1
    assert {device: waited > 0 for device, waited in overview.oldest_waiting_s.items()} == {
        "auto": False,
        "cpu": True,
        "cuda": False,
    }
    running.kill()
    start_worker("second", labels={"site": "lab2"})
    job = until(job)
    assert (job.state, job.worker, job.progress.waits_for) == (JobState.SUCCEEDED, "second", None), job


@pytest.fixture
def workstation(jobs, artifact_folder):
    """The gate of a worker, in this process, on a host with two GPUs and a processor."""

    def make(name):
        names = ("cuda:0", "cuda:1", "cpu")
        devices = [WorkerDevice(name=one, model="a model", memory_bytes=8 * 10**9) for one in names]
        locks = [DeviceLock(artifact_folder, HostDevice(one, one.name), name) for one in devices]
        return Gate(jobs.identity, locks, (), lambda: demands_waiting(jobs.engine))

    return make


def test_a_worker_of_several_devices_holds_one_that_fits_and_leaves_the_others(store, workstation):
    one, two = workstation("one"), workstation("two")
    assert one.opens() == []  # no job waits
    job = submit(store, "gpu", device="auto")
    (key,) = one.opens()
    assert two.opens() == []  # `one` holds all of them until it knows the job
    demand = Demand.of(job.specification)
    held = one.hold(demand)
    assert held.device.name == "cuda:0"
    assert two.opens() == [key]
    assert two.hold(demand) is not None
    third = workstation("third")
    assert third.opens() == []  # the processor is free, and is for jobs that ask for it
    cpu = Demand.of(submit(store, "cpu", device="cpu").specification)
    assert third.opens() == [cpu.key]
    assert third.hold(demand) is None
    one.close()
    assert third.hold(demand) is not None
    for gate in (two, third):
        gate.close()


def test_a_worker_that_rests_or_fits_nothing_does_not_hold_its_devices(store, workstation):
    submit(store, "elsewhere", site="lab1")
    one, two = workstation("one"), workstation("two")
    assert one.opens() == []
    submit(store, "here")
    assert two.opens() != []
    two.close()
    one.is_resting = True
    assert one.opens() == []
    one.is_resting = False
    assert one.opens() != []
    one.close()

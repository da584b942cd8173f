"""Which worker fits which job, and the words for a job that no worker fits; without any worker."""

import pytest

from ultragray.errors import InvalidArgument
from ultragray_workers.jobs.demand import (
    Demand,
    LivingWorker,
    Offer,
    WorkerDevice,
    demand_of_key,
    offer_of_json,
    waits_for,
)
from ultragray_workers.jobs.kinds import EvaluateJob, RenderJob, TrainJob
from ultragray_workers.jobs.kinds.base import to_dict

PROCESSOR = WorkerDevice(name="cpu", model="a processor", memory_bytes=64 * 10**9, cores=8)
SMALL_GPU = WorkerDevice(name="cuda:0", model="a GPU", memory_bytes=8_400_000_000)
LARGE_GPU = WorkerDevice(name="cuda:1", model="a larger GPU", memory_bytes=85 * 10**9)
LABELS = (("rack", "4"), ("site", "lab1"))
WORKSTATION = Offer((SMALL_GPU, LARGE_GPU, PROCESSOR), LABELS)
LAPTOP = Offer((PROCESSOR,))


@pytest.mark.parametrize(
    ("demand", "workstation", "laptop"),
    [
        (Demand(), ["cuda:0", "cuda:1"], ["cpu"]),
        (Demand("cpu"), ["cpu"], ["cpu"]),
        (Demand("cuda"), ["cuda:0", "cuda:1"], []),
        (Demand("cuda:1"), ["cuda:1"], []),
        (Demand("cuda:2"), [], []),
        (Demand(min_memory_gb=8), ["cuda:0", "cuda:1"], ["cpu"]),
        (Demand(min_memory_gb=9), ["cuda:1"], ["cpu"]),
        (Demand("cuda", min_memory_gb=86), [], []),
        (Demand("cpu", min_memory_gb=65), [], []),
        (Demand(labels=(("site", "lab1"),)), ["cuda:0", "cuda:1"], []),
        (Demand(labels=LABELS), ["cuda:0", "cuda:1"], []),
        (Demand(labels=(("site", "lab2"),)), [], []),
        (Demand("cpu", labels=(("rack", "4"), ("site", "lab2"))), [], []),
    ],
)
def test_the_devices_that_fit(demand, workstation, laptop):
    assert [device.name for device in WORKSTATION.fitting(demand)] == workstation
    assert [device.name for device in LAPTOP.fitting(demand)] == laptop


@pytest.mark.parametrize(
    ("demand", "words"),
    [
        (Demand(), "a worker"),
        (Demand("cuda"), "a worker with a GPU"),
        (Demand("cuda:1"), "a worker with the GPU cuda:1"),
        (Demand("cpu", 16), "a worker with the device cpu of at least 16 GB"),
        (Demand(min_memory_gb=16), "a worker with a device of at least 16 GB"),
        (Demand(labels=LABELS), "a worker with the labels rack=4, site=lab1"),
        (Demand("cuda", 16, LABELS[1:]), "a worker with a GPU of at least 16 GB and the label site=lab1"),
    ],
)
def test_a_demand_in_words_and_there_and_back(demand, words):
    assert str(demand) == words
    assert demand_of_key(demand.key) == demand


def test_every_kind_of_job_demands_what_its_specification_says():
    asked = {"device": "cuda", "min_memory_gb": 8, "worker_labels": {"site": "lab1", "rack": "4"}}
    jobs = (
        TrainJob("liver", "liver", **asked),
        EvaluateJob("liver", "liver", **asked),
        RenderJob(scene="liver", poses=[[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]], **asked),
    )
    assert {Demand.of(to_dict(job)) for job in jobs} == {Demand("cuda", 8, LABELS)}
    assert Demand.of(to_dict(TrainJob("liver", "liver"))) == Demand()


@pytest.mark.parametrize(
    ("asked", "field"),
    [
        ({"device": "gpu"}, "device"),
        ({"device": "cuda:x"}, "device"),
        ({"min_memory_gb": 0}, "min_memory_gb"),
        ({"min_memory_gb": 1.5}, "min_memory_gb"),
        ({"min_memory_gb": "8GB"}, "min_memory_gb"),
        ({"worker_labels": ["site"]}, "worker_labels"),
        ({"worker_labels": {"site": 1}}, "worker_labels"),
        ({"worker_labels": {"": "lab1"}}, "worker_labels"),
        ({"worker_labels": {"site": "lab 1"}}, "worker_labels"),
        ({"worker_labels": {"site": "x" * 64}}, "worker_labels"),
        ({"worker_labels": {f"n{number}": "x" for number in range(11)}}, "worker_labels"),
    ],
)
def test_a_demand_that_no_worker_could_meet_is_refused_with_its_field(asked, field):
    with pytest.raises(InvalidArgument, match=f"^{field} must be") as caught:
        EvaluateJob("liver", "liver", **asked)
    assert caught.value.field == field


def test_the_largest_demand_fits_into_an_index_of_postgresql():
    labels = tuple((f"{number}{'n' * 62}", "v" * 63) for number in range(10))
    assert len(Demand("cuda:999", 10**6, labels).key) < 2000


def test_an_offer_there_and_back():
    assert offer_of_json(WORKSTATION.to_json()) == WORKSTATION
    assert offer_of_json(None).devices == ()


def test_a_job_that_nobody_can_take_says_what_it_asks_and_what_there_is():
    demand = Demand("cuda", 16, (("site", "lab2"),))
    asked = "a worker with a GPU of at least 16 GB and the label site=lab2"
    workstation, laptop = LivingWorker("big", WORKSTATION, False), LivingWorker("small", LAPTOP, False)
    assert waits_for(demand, []) == f"{asked}: none is running"
    assert waits_for(demand, [workstation, laptop]) == (
        f"{asked}; there is big (cuda:0 of 8 GB, cuda:1 of 85 GB, cpu of 64 GB, rack=4, site=lab1), "
        "small (cpu of 64 GB)"
    )
    many = [LivingWorker(f"w{number}", LAPTOP, False) for number in range(100)]
    assert (waits_for(demand, many) or "").endswith("w2 (cpu of 64 GB) and 97 more")
    assert waits_for(Demand("cuda"), [laptop, workstation]) is None
    resting = LivingWorker("big", WORKSTATION, True)
    assert waits_for(Demand("cuda"), [laptop, resting]) == (
        "a worker with a GPU that takes jobs; "
        "big (cuda:0 of 8 GB, cuda:1 of 85 GB, cpu of 64 GB, rack=4, site=lab1) rests"
    )

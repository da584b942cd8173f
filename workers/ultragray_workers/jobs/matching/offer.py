"""The offer of a worker: its devices and labels, and which jobs fit them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from functools import lru_cache

from ultragray.contract import described
from ultragray_workers.jobs.matching.demand import AUTO, CPU, CUDA, GB, Demand, labels_in_words

_NAMED_WORKERS = 3  # in a sentence


@dataclass(frozen=True, kw_only=True)
class WorkerDevice:
    """A device that a worker does jobs on."""

    name: str = described("cpu or cuda:N.")
    model: str = described("Name of the processor or the GPU.")
    memory_bytes: int = described("Of the GPU; of cpu: of the host, or of the worker's container.")
    cores: int | None = described("Of cpu: those that the worker may use; null: a GPU.", None)

    def __str__(self) -> str:
        return f"{self.name} of {self.memory_bytes / GB:.0f} GB"


@dataclass(frozen=True)
class Offer:
    """The devices of a worker, the preferred one first, and its labels."""

    devices: tuple[WorkerDevice, ...]
    labels: tuple[tuple[str, str], ...] = ()  # names and values, by name

    def fitting(self, demand: Demand) -> tuple[WorkerDevice, ...]:
        """The devices that a job with this demand can run on; none where the labels differ.

        A job that leaves the choice to the worker gets its processor only where the worker offers no GPU.
        """
        if not set(demand.labels) <= set(self.labels):
            return ()
        gpus = tuple(device for device in self.devices if device.name != CPU)
        chosen = {AUTO: gpus or self.devices, CUDA: gpus}.get(
            demand.device, tuple(device for device in self.devices if device.name == demand.device)
        )
        return tuple(device for device in chosen if device.memory_bytes >= demand.min_memory_gb * GB)

    def to_json(self) -> str:
        """The offer as the table of workers keeps it."""
        return json.dumps({"devices": [asdict(device) for device in self.devices], "labels": dict(self.labels)})

    def __str__(self) -> str:
        """Such as "cuda:0 of 85 GB, cpu of 128 GB, site=lab1"."""
        return ", ".join([*map(str, self.devices), *([labels_in_words(self.labels)] if self.labels else [])])


NO_OFFER = Offer(())


@lru_cache(maxsize=1024)
def offer_of_json(text: str | None) -> Offer:
    """Inverse of `Offer.to_json`; None: of a worker that tells none. Facts of a later release are left out."""
    if text is None:
        return NO_OFFER
    values = json.loads(text)
    known = {item.name for item in fields(WorkerDevice)}
    devices = ({name: fact for name, fact in one.items() if name in known} for one in values["devices"])
    return Offer(tuple(WorkerDevice(**facts) for facts in devices), tuple(sorted(values["labels"].items())))


@dataclass(frozen=True)
class LivingWorker:
    """A worker that gives signs of life."""

    name: str
    offer: Offer
    is_resting: bool  # an administrator wants it to take no jobs


def waits_for(demand: Demand, workers: Sequence[LivingWorker]) -> str | None:
    """The worker that a job waits for, in words; None where one that lives can do the job."""
    fitting = [worker for worker in workers if worker.offer.fitting(demand)]
    if any(not worker.is_resting for worker in fitting):
        return None
    if fitting:
        return f"{demand} that takes jobs; {_listed([f'{worker.name} ({worker.offer})' for worker in fitting])} rests"
    if not workers:
        return f"{demand}: none is running"
    return f"{demand}; there is {_listed([f'{worker.name} ({worker.offer})' for worker in workers])}"


def _listed(names: Sequence[str]) -> str:
    more = len(names) - _NAMED_WORKERS
    return ", ".join(names[:_NAMED_WORKERS]) + (f" and {more} more" if more > 0 else "")

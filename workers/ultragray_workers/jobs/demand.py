"""The demand of a job (device, memory, labels), the offer of a worker, and which jobs fit which worker.

`jobs.queue` keeps the key of a demand with its job; `worker.device.Gate` takes only jobs that the worker's offer fits.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any

from ultragray.contract import described, shown
from ultragray.errors import InvalidArgument

AUTO, CPU, CUDA = "auto", "cpu", "cuda"
GB = 10**9  # as makers of memory and GPUs count: a GPU of 8 GB has a little more than 8 * 10^9 bytes
MAX_LABELS = 10  # the key of a demand stands in an index, whose entries PostgreSQL limits to 2,700 bytes
MAX_MEMORY_GB = 1_000_000
_NAMED_WORKERS = 3  # in a sentence
_DEVICE = re.compile(r"auto|cpu|cuda(:\d{1,3})?")
_LABEL = re.compile(r"[A-Za-z0-9][A-Za-z0-9._/-]{0,62}")


@dataclass(frozen=True)
class Demand:
    """What a worker must have to do a job."""

    device: str = AUTO  # auto: a GPU where the worker offers one, else its processor; cpu, cuda (any GPU) or cuda:N
    min_memory_gb: int = 0  # of the device, 10^9 bytes
    labels: tuple[tuple[str, str], ...] = ()  # names and values, by name

    @classmethod
    def of(cls, specification: Mapping[str, Any]) -> Demand:
        """The demand of a job's specification in JSON, whatever its kind."""
        return cls(
            device=specification.get("device") or AUTO,
            min_memory_gb=specification.get("min_memory_gb") or 0,
            labels=tuple(sorted((specification.get("worker_labels") or {}).items())),
        )

    @property
    def key(self) -> str:
        """A text that is the same for equal demands, and from which `demand_of_key` makes the demand again."""
        return json.dumps({**asdict(self), "labels": dict(self.labels)}, sort_keys=True, separators=(",", ":"))

    def __str__(self) -> str:
        """Such as "a worker with a GPU of at least 16 GB and the label site=lab1"."""
        parts = []
        if self.device != AUTO or self.min_memory_gb:
            words = {AUTO: "a device", CPU: "the device cpu", CUDA: "a GPU"}
            memory = f" of at least {self.min_memory_gb} GB" if self.min_memory_gb else ""
            parts.append(words.get(self.device, f"the GPU {self.device}") + memory)
        if self.labels:
            parts.append(f"the label{'s' * (len(self.labels) > 1)} {labels_in_words(self.labels)}")
        return f"a worker with {' and '.join(parts)}" if parts else "a worker"


@lru_cache(maxsize=4096)
def demand_of_key(key: str) -> Demand:
    values = json.loads(key)
    return Demand(values["device"], values["min_memory_gb"], tuple(sorted(values["labels"].items())))


def labels_in_words(labels: tuple[tuple[str, str], ...]) -> str:
    """Such as "rack=4, site=lab1"."""
    return ", ".join(f"{name}={value}" for name, value in labels)


def check_device(device: str) -> None:
    """Raises InvalidArgument for what is no device."""
    if not _DEVICE.fullmatch(device):
        raise InvalidArgument(f"device must be auto, cpu, cuda or cuda:N, got {shown(device)}", field="device")


def check_labels(labels: Mapping[Any, Any], field: str) -> None:
    """Raises InvalidArgument for too many labels, and for names and values that are none."""
    if len(labels) > MAX_LABELS:
        raise InvalidArgument(f"{field} must be at most {MAX_LABELS} labels, got {len(labels)}", field=field)
    for text in (text for label in labels.items() for text in label):
        if not isinstance(text, str) or not _LABEL.fullmatch(text):
            raise InvalidArgument(
                f"{field} must be names and values of 1 to 63 letters, digits, '.', '_', '/' or '-' that begin with a "
                f"letter or a digit, got {shown(text)}",
                field=field,
            )


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
    if text is None:
        return NO_OFFER
    values = json.loads(text)
    devices = tuple(WorkerDevice(**one) for one in values["devices"])
    return Offer(devices, tuple(sorted(values["labels"].items())))


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

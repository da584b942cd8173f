"""Workers, as the service tells them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from ultragray_proto.codec import from_message
from ultragray_proto.v1 import workers_pb2


class WorkerState(str, Enum):
    """What a worker does."""

    IDLE = "idle"
    WORKING = "working"
    PAUSING = "pausing"  # at its last job
    PAUSED = "paused"
    DRAINING = "draining"  # its job is about to go back into the queue, or is its last
    DRAINED = "drained"
    LOST = "lost"  # it has given no sign of life for 10 s, or was stopped while paused


@dataclass(frozen=True)
class WorkerDevice:
    """A device that a worker does jobs on."""

    name: str  # cpu or cuda:N
    model: str  # name of the processor or the GPU
    memory_bytes: int  # of the GPU; of cpu: of the host, or of the worker's container
    cores: int | None  # of cpu: those that the worker may use; None: a GPU


@dataclass(frozen=True)
class Worker:
    """A process that does jobs."""

    name: str
    state: WorkerState
    host: str
    pid: int
    device: str  # as it was started with: auto, cpu, cuda or cuda:N
    version: str  # of its release
    started_at: str | None  # ISO 8601, UTC
    seconds_since_beat: float | None  # since its last sign of life; None: it was stopped
    job: str | None  # the job at hand; None: none, or one that is private to somebody else
    devices: tuple[WorkerDevice, ...]  # those that it does jobs on, the preferred one first
    labels: Mapping[str, str]  # those that jobs can ask for


def worker_from_message(message: workers_pb2.Worker) -> Worker:
    """A worker as the service tells it."""
    return from_message(message, Worker)

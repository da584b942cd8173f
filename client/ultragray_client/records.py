"""What the service tells: of scenes, jobs, workers, registrations and callers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, get_args

import numpy as np

from ultragray_client.contract import ElevationBeam, Probe, Specification
from ultragray_client.geometry import FloatArray
from ultragray_proto.codec import from_message
from ultragray_proto.v1 import jobs_pb2, scenes_pb2

Point = tuple[float, float, float]  # x, y, z in the scene's frame, mm


@dataclass(frozen=True)
class SceneEntry:
    """A scene of the list; 0 where a size is not known. With an `error` only the name holds."""

    name: str
    loaded: bool  # by at least one render process
    gaussian_count: int
    image_height: int
    image_width: int
    file_bytes: int
    error: str | None  # why the file cannot be read
    owner: str | None  # None: nobody
    private: bool  # others do not see it
    probe_kind: str | None  # of the probe it was trained with, such as "convex"
    metrics: Mapping[str, float]  # of the training, on held-out frames
    changed_at: str | None  # when its file was last written, ISO 8601, UTC


@dataclass(frozen=True)
class ConfidenceFit:
    """Quality of the confidence that a scene tells of its frames."""

    error: float  # mean absolute error of the confidence on the views that it was fitted on
    fitted_on: int  # how many those are


@dataclass(frozen=True)
class Mode:
    """A way in which the tissue of a scene moves."""

    name: str  # such as breathing
    low: float  # the least number that a frame was seen with
    high: float  # the greatest
    rest: float  # the number at which the tissue is where the scene has it
    unit: str  # of the number; empty: it has none
    surrogate: str  # what told the number, such as a belt


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene; None, 0 or empty where it is not known."""

    name: str
    loaded_processes: int  # render processes that hold it
    file_bytes: int
    gaussian_count: int
    sh_degree: int
    intensity: str
    centre_mm: Point
    bounds_min_mm: Point  # of the Gaussians' means
    bounds_max_mm: Point
    probe: Probe | None  # the one it was trained with
    image_height: int
    image_width: int
    training_pose_count: int
    training_position_min_mm: Point | None  # of the probe's origin
    training_position_max_mm: Point | None
    training_poses: tuple[FloatArray, ...] = field(repr=False)  # the first, the middle and the last, each [4, 4] mm
    metrics: Mapping[str, float]
    dataset_name: str
    dataset_sha256: str
    label_names: Mapping[int, str]  # what the values of the output labels mean
    beam: ElevationBeam | None  # of the frames it was trained on; None: they are taken for planes
    confidence: ConfidenceFit | None  # None: it cannot tell the confidence of its frames
    modes: tuple[Mode, ...]  # by which its tissue moves, a number of `phase` for each; empty: it is still
    speckle: bool  # whether its frames can have natural speckle
    owner: str | None  # None: nobody
    private: bool  # others do not see it
    parents: Mapping[str, str]  # SHA-256 by name of the scenes that edits made it of
    edits: tuple[str, ...]  # what was done to them, each in JSON
    made_labels: tuple[str, ...]  # of what was never recorded: put in, made or moved


def entry_from_message(message: scenes_pb2.SceneEntry) -> SceneEntry:
    """A scene of the list."""
    return from_message(message, SceneEntry, error=message.error.detail or None)


def scene_from_message(message: scenes_pb2.Scene) -> Scene:
    """All that is told of a scene; of its training poses only where there are any."""
    training = message.training_poses
    known = from_message(training, _TrainingPoses) if training.count else None
    return from_message(
        message,
        Scene,
        training_pose_count=training.count,
        training_position_min_mm=known and known.position_min_mm,
        training_position_max_mm=known and known.position_max_mm,
        training_poses=(known.first, known.middle, known.last) if known else (),
        modes=tuple(from_message(mode, Mode) for mode in message.motion.modes),
    )


@dataclass(frozen=True)
class _TrainingPoses:
    position_min_mm: Point
    position_max_mm: Point
    first: FloatArray
    middle: FloatArray
    last: FloatArray


_KINDS: dict[str, Any] = {cls.kind: cls for cls in get_args(Specification)}


class JobState(str, Enum):
    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def final(self) -> bool:
        return self not in (JobState.QUEUED, JobState.RUNNING)


@dataclass(frozen=True)
class JobProgress:
    """Progress of a job; None: does not apply, or not yet."""

    step: int | None
    steps: int | None
    loss: float | None
    val_psnr_db: float | None  # on the held-out frames, the last time it was measured
    gaussians: int | None
    frames_done: int | None
    frames: int | None
    rate_per_s: float | None  # steps or frames
    seconds_left: float | None  # until the end of the job, about
    waits_for: str | None  # of a job that waits: what else it needs than its turn, such as a worker that fits it
    method: str | None  # of a comparison: the method at hand
    method_number: int | None  # its number among the methods, from 1
    methods: int | None
    phase: str | None  # of a training that runs: baselines, effort, training, evaluation, confidence or report


@dataclass(frozen=True)
class JobError:
    """The reason of a failed job."""

    reason: str  # stable
    detail: str  # one sentence


@dataclass(frozen=True)
class Job:
    """Work that the service does in the background. Times are ISO 8601, UTC; None: not yet."""

    id: str
    kind: str  # that of its specification
    state: JobState
    request_id: str
    specification: Specification  # as it was asked for, but for the poses
    pose_count: int  # how many of those there were
    priority: int
    created_at: str
    started_at: str | None
    finished_at: str | None
    error: JobError | None
    progress: JobProgress
    artifacts: tuple[str, ...]  # names of the files to download
    metrics: Mapping[str, float]  # of a trained scene on the held-out frames
    worker: str | None
    retry_of: str | None  # the job that this one goes on from
    attempts: int  # how often it was started
    owner: str | None  # who submitted it
    private: bool  # others do not see it


@dataclass(frozen=True)
class JobEvent:
    """News of a job."""

    job: Job | None  # where it changed
    log: str  # new lines


def job_from_message(message: jobs_pb2.Job) -> Job:
    """A job as the service tells it."""
    kind = message.WhichOneof("specification")
    cls = _KINDS[kind]
    others = {"poses": None} if hasattr(cls, "poses") else {}
    specification = from_message(getattr(message, kind), cls, **others)
    return from_message(message, Job, specification=specification, pose_count=message.render.pose_count)


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


@dataclass(frozen=True, eq=False, kw_only=True)
class Registration:
    """How a robot lies to a scene: probe→scene = base_to_scene · flange→base · probe_to_flange.

    For a tracked probe the base is the tracker, and the flange the marker on the probe.
    """

    name: str
    scene: str
    base_to_scene: FloatArray  # [4, 4] mm
    probe_to_flange: FloatArray = field(default_factory=lambda: np.eye(4))  # [4, 4] mm
    residual_mm: float | None  # root mean square; None: not known
    residual_deg: float | None
    position_std_mm: tuple[float, float, float] | None  # standard deviations of base_to_scene, where it was found
    angle_std_deg: tuple[float, float, float] | None  # about the axes of the scene
    owner: str | None  # who put it
    changed_at: str  # ISO 8601, UTC


class Role(str, Enum):
    """What a key may do; each role includes those before it."""

    READER = "reader"  # sees, renders, streams
    OPERATOR = "operator"  # and has jobs, datasets and scenes
    ADMIN = "admin"  # everything


@dataclass(frozen=True)
class Me:
    """Whom the key stands for."""

    name: str  # the owner of what they make
    role: Role
    expires_at: str | None  # ISO 8601, UTC; None: never
    key_required: bool  # without, everybody is an admin


@dataclass(frozen=True)
class AuditEntry:
    """One line of the service's audit log."""

    at: str  # ISO 8601, UTC
    who: str  # the name of the key; "-": without a known one
    address: str  # that connected
    what: str  # the operation, such as scene.delete
    target: str  # the scene, dataset or job; empty: none
    result: str  # OK, or the reason of the refusal
    facts: Mapping[str, Any]  # such as count or frames

"""The state of a job, how far it is, how its work ended, and its files: what its row keeps as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import Enum
from functools import cache
from typing import Any, ClassVar, TypeVar

from pydantic import TypeAdapter

from ultragray.contract import described

_T = TypeVar("_T")
PHASES = ("baselines", "effort", "training", "evaluation", "confidence", "report", "live")


class JobState(str, Enum):
    """The state of a job in its life."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def is_final(self) -> bool:
        """Whether the job neither waits nor runs."""
        return self not in (JobState.QUEUED, JobState.RUNNING)


@dataclass(frozen=True)
class Progress:
    """The progress of a job; null for what does not apply, or not yet."""

    __pydantic_config__: ClassVar[dict[str, Any]] = {"json_schema_serialization_defaults_required": True}

    step: int | None = described("Steps that are done of a training, or of the method at hand of a comparison.", None)
    steps: int | None = None
    loss: float | None = None
    val_psnr_db: float | None = described(
        "On some held-out frames, the last time it was measured; metrics are of all of them.", None
    )
    gaussians: int | None = None
    frames_done: int | None = described(
        "Frames that are done, such as those of a render job in its archive; of a volume: layers of voxels.", None
    )
    frames: int | None = None
    rate_per_s: float | None = described("Steps or frames.", None)
    seconds_left: float | None = described("Until the end of the job, of all that is still to be done; about.", None)
    waits_for: str | None = described(
        "Of a job that waits: what else it needs than its turn, such as a worker that offers what it asks for.", None
    )
    method: str | None = described("Of a comparison: the method at hand.", None)
    method_number: int | None = described("Its number among the methods of the comparison, from 1.", None)
    methods: int | None = None
    phase: str | None = described(
        "Of a training that runs: classical methods are measured, the effort is chosen, it trains, it is measured on "
        "the held-out frames, its confidence is fitted, or its report is written. Of a live job also: it follows the "
        "recording.",
        None,
        choices=PHASES,
    )


@dataclass(frozen=True)
class Outcome:
    """The end of a job's work: artifacts, or a reason."""

    error: str | None = None  # stable reason, such as DATASET_INVALID; None: it succeeded
    reason: str | None = None  # one sentence
    artifacts: tuple[str, ...] = ()
    sha256: dict[str, str] = field(default_factory=dict)  # of those artifacts that were hashed while they were written
    metrics: dict[str, float] = field(default_factory=dict)
    progress: Progress = Progress()
    attempts: int = 1  # how often a process was started for it


@dataclass(frozen=True)
class StoredFile:
    key: str
    bytes: int
    sha256: str


@dataclass(frozen=True)
class Piece:
    """A part of a file that grows: the first bytes of an object, which may have more already."""

    key: str
    bytes: int


@dataclass(frozen=True)
class Files:
    """The objects of a job that count. Others under its keys are half written, or of an attempt that was cut off.

    jobs/ID/NAME.ugr            the scene that the job needs, as it was when the job was submitted
    jobs/ID/ATTEMPT/log-N       pieces of the log; the last of an attempt grows; likewise journal-N, of a training
    jobs/ID/ATTEMPT/run-N/      a checkpoint, with all that a process needs to go on from it
    jobs/ID/ATTEMPT/artifacts/  what can be downloaded
    jobs/ID/batch/              what can be downloaded of a batch, see `batches.place`: many workers write it
    """

    log: tuple[Piece, ...] = ()
    journal: tuple[Piece, ...] = ()  # of the attempt at hand
    run: Mapping[str, StoredFile] = field(default_factory=dict)  # the newest checkpoint, by the paths of its files
    artifacts: Mapping[str, StoredFile] = field(default_factory=dict)

    def keys(self) -> set[str]:
        pieces = {piece.key for piece in (*self.log, *self.journal)}
        return pieces | {file.key for file in (*self.run.values(), *self.artifacts.values())}


def to_json(value: Any) -> str:
    """One of these classes as its row, and the folder of its attempt, keep it; or plain values."""
    return json.dumps(value, default=asdict)


def from_json(kind: type[_T], text: str | bytes) -> _T:
    """Inverse of `to_json`; what is left out keeps its default. Raises ValueError."""
    reader: Any = kind  # mypy takes no class for what a cache can hold
    value: _T = _adapter(reader).validate_python(json.loads(text))
    return value


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)

"""The state of a job, how far it is, and how its work ended: what its process says, and its row keeps."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from enum import Enum
from typing import Any, ClassVar

from ultragray.contract import described

PHASES = ("baselines", "effort", "training", "evaluation", "confidence", "report")


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
    val_psnr_db: float | None = described("On the held-out frames, the last time it was measured.", None)
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
        "the held-out frames, its confidence is fitted, or its report is written.",
        None,
        choices=PHASES,
    )

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> Progress:
        return cls(**{item.name: document.get(item.name) for item in fields(cls)})


@dataclass(frozen=True)
class Outcome:
    """The end of a job's work: artifacts, or a reason."""

    error: str | None = None  # stable reason, such as DATASET_INVALID; None: it succeeded
    reason: str | None = None  # one sentence
    artifacts: tuple[str, ...] = ()
    metrics: dict[str, float] = field(default_factory=dict)
    progress: Progress = Progress()
    attempts: int = 1  # how often a process was started for it

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Outcome:
        values = json.loads(text)
        values["artifacts"] = tuple(values["artifacts"])
        values["progress"] = Progress.from_dict(values["progress"])
        return cls(**values)

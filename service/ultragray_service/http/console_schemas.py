"""The JSON of what the console shows besides scenes, datasets and jobs."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field

FlatPose = list[float]


class ImagePlane(BaseModel):
    """The image plane of a probe, told by its scan lines: x lateral, z axial, mm."""

    face_depth_mm: float = Field(description="Depth of the face, from which a scanner counts.")
    pivot_depth_mm: float = Field(
        description="Where the middle of the face lies on the axial axis: a probe is turned about it."
    )
    lines_mm: list[tuple[float, float, float, float]] = Field(
        description="From the left edge of the image to its right one, at even distances: x and z where the image "
        "begins, x and z where it ends."
    )


class ScenePoses(BaseModel):
    """Training poses of a scene, evenly taken."""

    poses: list[FlatPose] = Field(description="16 numbers each, row by row, mm.")


class DatasetPoses(BaseModel):
    """The poses of a dataset."""

    train: list[FlatPose] = Field(description="16 numbers each, row by row, mm.")
    val: list[FlatPose] = Field(description="Of the held-out frames.")


class ComparedFrame(BaseModel):
    """How near the scene, and median compounding, come to a held-out frame."""

    index: int
    frame_number: int = Field(description="As the dataset numbers it.")
    psnr_db: float
    ms_ssim: float
    gms: float
    gmsd: float
    median_psnr_db: float
    median_ms_ssim: float
    median_gms: float
    median_gmsd: float


class ComparisonOut(BaseModel):
    """A scene beside the held-out frames of its dataset."""

    state: Literal["running", "ready", "failed"]
    progress: float = Field(description="0 to 1.")
    dataset: str
    frames: list[ComparedFrame] = Field(description="Empty until it is ready.")
    reason: str | None = Field(description="Why it failed: one sentence.")
    error: str | None = Field(description="Why it failed: the stable reason, such as DATASET_INVALID.")


class StageTimes(BaseModel):
    """Where the time of a request went, ms."""

    queue: float
    render: float
    encode: float


class StatisticsStep(BaseModel):
    """What happened in one step."""

    seconds_ago: int = Field(description="0: it is going on; 5: it ended up to 5 s ago, and so on.")
    frames: int
    requests: int = Field(description="Rendered ones.")
    errors: int = Field(description="Requests and messages that the service could not answer as asked: 429 and 5xx.")
    p50_ms: StageTimes | None = Field(description="null where nothing was rendered.")
    p99_ms: StageTimes | None


class StatisticsOut(BaseModel):
    """The service now and in the last minutes."""

    step_s: int = Field(description="Length of a step.")
    steps: list[StatisticsStep] = Field(description="The oldest first.")
    waiting_frames: int
    busy_processes: int
    processes: int = Field(description="Render processes alive.")
    process_restarts: int
    memory_bytes: int = Field(description="Of the service and its render processes.")
    loaded_scenes: int
    jobs: dict[str, int] = Field(description="By state, counted every 10 s; empty where that is not known.")


class CurvePointOut(BaseModel):
    """Neighbouring steps of a training as one."""

    step: int = Field(description="The last of them.")
    loss: float = Field(description="Their mean.")
    val_psnr_db: float | None = Field(description="On held-out frames; null where it was not measured.")


class TrainingCurve(BaseModel):
    """A training so far."""

    points: list[CurvePointOut] = Field(description="At most 500.")

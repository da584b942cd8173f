"""The JSON of jobs."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, Field

from ultragray_workers.jobs.store import Job

from .schemas import RequestModel

JobKind = Literal["train", "render"]
State = Literal["queued", "running", "succeeded", "failed", "cancelled"]


class TrainSpecification(BaseModel):
    """A dataset becomes a scene that is served."""

    dataset: str = Field(description="Name of an uploaded dataset.")
    scene: str = Field(description="Name that the scene will be served under.")
    preset: str = Field("fast", description="fast, or paper: the released recipe.")
    settings: dict[str, Any] = Field({}, description="Any training settings instead of the preset's.")
    device: str = Field("auto", description="auto, cpu, cuda or cuda:N.")


class SamplerBody(BaseModel):
    """Poses made from the given poses, else from the scene's training poses; each kind takes its own keys only.

    training: the training poses themselves. around: some of them, moved at random. spline: on a smooth path through
    them. fan: all of them, tilted about the lateral axis. covered: uniform within the region that they cover.
    """

    kind: Literal["training", "around", "spline", "fan", "covered"]
    count: int | None = Field(None, description="around, spline, covered: how many poses.")
    translation_mm: float | None = Field(None, description="around: standard deviation along each axis; default 2.")
    rotation_deg: float | None = Field(None, description="around: standard deviation of the angle; default 5.")
    seed: int | None = Field(None, description="around, covered: of the random choices; default 0.")
    spacing_mm: float | None = Field(None, description="spline, instead of count: distance along the path.")
    tilt_deg: float | None = Field(None, description="fan: the largest tilt, to both sides.")
    step_deg: float | None = Field(None, description="fan: between two tilts.")


class RenderSpecification(BaseModel):
    """Many frames of a scene become one archive, at `poses`, or at those that `sampler` makes."""

    scene: str
    poses: list[list[list[float]]] | None = Field(None, description="4x4 matrices, mm.")
    sampler: SamplerBody | None = None
    height: int | None = Field(None, description="Depth samples. Default: as trained, else 512.")
    width: int | None = Field(None, description="Scan lines. Default: as trained, else 512.")
    outputs: list[str] = Field(["bmode"], description="Some of bmode, echo, transmittance, coverage, labels.")
    format: Literal["npz", "tar", "zarr", "hdf5", "dicom", "plus"] = Field(
        "npz", description="tar: WebDataset; dicom and plus (.igs.mha): bmode in uint8."
    )
    dtype: Literal["uint8", "float32"] | None = Field(None, description="Default: the format's own.")
    min_confidence: float | None = Field(
        None,
        description="0 to 1. Poses below it are refused. Samplers keep within it: around and covered draw on until "
        "they have their count, the others leave such poses out.",
    )


class JobBody(RequestModel):
    """A job to be done in the background."""

    kind: JobKind
    specification: dict[str, Any] = Field(
        description="TrainSpecification or RenderSpecification, by kind.",
        json_schema_extra={
            "anyOf": [
                {"$ref": f"#/components/schemas/{model.__name__}"}
                for model in (TrainSpecification, RenderSpecification)
            ]
        },
    )
    request_id: str | None = Field(
        None, description="Chosen by the client, 1 to 128 characters: sent again, it gives the same job."
    )
    priority: int = Field(0, description="-1000 to 1000; higher ones go first.")


class ProgressOut(BaseModel):
    """How far a job is; null for what does not apply, or not yet."""

    step: int | None = Field(description="Steps of a training that are done.")
    steps: int | None
    loss: float | None
    val_psnr_db: float | None = Field(description="On the held-out frames, the last time it was measured.")
    gaussians: int | None
    frames_done: int | None = Field(description="Frames of a render job that are in its archive.")
    frames: int | None
    rate_per_s: float | None = Field(description="Steps or frames.")
    seconds_left: float | None
    waits_for: str | None = Field(description="The device, while another job of the same host is at work on it.")


class JobOut(BaseModel):
    """A job."""

    id: str
    kind: JobKind
    state: State
    request_id: str | None
    specification: dict[str, Any] = Field(description="As it was sent; of poses only their number, as pose_count.")
    priority: int
    created_at: str = Field(description="ISO 8601, UTC; likewise the other times.")
    started_at: str | None
    finished_at: str | None
    reason: str | None = Field(description="Why it failed: one sentence.")
    error: str | None = Field(description="Why it failed: the stable reason, such as DATASET_INVALID.")
    progress: ProgressOut
    artifacts: list[str] = Field(description="Names of the files to download.")
    metrics: dict[str, float] = Field(description="Of a trained scene on the held-out frames.")
    worker: str | None
    retry_of: str | None = Field(description="The job that this one goes on from.")
    attempts: int = Field(description="How often it was started.")

    @classmethod
    def of(cls, job: Job) -> JobOut:
        """The JSON of a job."""
        progress = job.progress
        return cls(
            id=job.id,
            kind="train" if job.kind == "train" else "render",
            state=job.state.value,
            request_id=job.request_id,
            specification={name: value for name, value in job.specification.items() if name != "kind"},
            priority=job.priority,
            created_at=job.created_at,
            started_at=job.started_at,
            finished_at=job.finished_at,
            reason=job.reason,
            error=job.error,
            progress=ProgressOut(
                step=progress.step,
                steps=progress.steps,
                loss=progress.loss,
                val_psnr_db=progress.val_psnr_db,
                gaussians=progress.gaussians,
                frames_done=progress.frames_done,
                frames=progress.frames,
                rate_per_s=progress.rate_per_s,
                seconds_left=progress.seconds_left,
                waits_for=progress.waits_for,
            ),
            artifacts=list(job.artifacts),
            metrics=dict(job.metrics),
            worker=job.worker,
            retry_of=job.retry_of,
            attempts=job.attempts,
        )


class JobPage(BaseModel):
    """One page of jobs, newest first."""

    jobs: list[JobOut]
    next_page_token: str = Field(description="Empty on the last page.")

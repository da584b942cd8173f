"""What a render job would make, told before it is submitted: how many frames, how large, how long, and where."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

from ultragray.contract import described, under
from ultragray.errors import InvalidArgument
from ultragray.geometry.probe import FloatArray
from ultragray.rendering.settings import Encoding
from ultragray_service.core.rendering import Plan, Rendering
from ultragray_workers.errors import DeadlineExceeded, QueueFull
from ultragray_workers.jobs.kinds import RenderJob, Specification
from ultragray_workers.pool.messages import Priority

MAX_POSES = 256  # that an estimate tells
_TIMED_FRAMES = 2  # one after the other: the first may load the scene


@dataclass(frozen=True)
class JobEstimate:
    """What a render job would make; nothing is submitted."""

    frames: int = described("Frames; a sampler that keeps to a least confidence may leave some out.")
    files: int = described("Files that they become.")
    height: int = described("Of a frame, pixels.")
    width: int = described("Of a frame, pixels.")
    bytes: int = described("Of the files, at most: as they are before they are compressed.")
    seconds: float | None = described(
        "Rendering on the processes of this service, one frame after the other; null where they are too busy to tell. "
        "Workers with a GPU, or several of them, are faster."
    )
    poses: list[list[float]] = described(
        f"At most {MAX_POSES} of the poses, evenly spread: 16 numbers each, row by row, mm."
    )


async def estimate(rendering: Rendering, specification: Specification, *, field: str) -> JobEstimate:
    """The estimate of a job. `field` is where the caller wrote the specification.

    Raises InvalidArgument for a job of another kind, and what its submission would raise for what it asks of the scene.
    """
    if not isinstance(specification, RenderJob):
        raise InvalidArgument(
            f"only render jobs can be estimated, this is of the kind {specification.kind}", field="kind"
        )
    with under(field):
        plan = await rendering.planner.plan(
            specification.scene, specification, Encoding.UINT8, registration=specification.registration
        )
        if plan.registration is not None:
            specification = specification.registered(plan.registration)
        settings = plan.settings
        frames, poses = await asyncio.to_thread(specification.outlook, plan.header, settings, MAX_POSES)
        picture = specification.file_format.shown(settings).picture
    frame_s = await _frame_s(rendering, plan, poses[:1])
    return JobEstimate(
        frames=frames,
        files=specification.file_count(frames),
        height=picture.height,
        width=picture.width,
        bytes=specification.file_bytes(frames, picture),
        seconds=None if frame_s is None else frames * frame_s,
        poses=poses.reshape(-1, 16).tolist(),
    )


async def _frame_s(rendering: Rendering, plan: Plan, poses: FloatArray) -> float | None:
    """The seconds that one frame takes; None where there is no room for it now."""
    deadline, took_ms = rendering.planner.deadline(None), 0.0
    try:
        for _ in range(_TIMED_FRAMES):
            await rendering.limits.take_frames(len(poses), deadline)
            took_ms = (await rendering.render(plan, poses, priority=Priority.BATCH, deadline=deadline)).render_ms
    except (DeadlineExceeded, QueueFull):
        return None
    return took_ms / 1000.0

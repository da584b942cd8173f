"""Batch rendering: frames of a scene become one archive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt
from typing_extensions import Self

from ultragray.contract import described, kind_field, shown, under
from ultragray.errors import InvalidArgument
from ultragray.exchange.batches import SHARD_FRAMES, BatchPlan
from ultragray.exchange.exports import FORMATS, Format, check_format
from ultragray.exchange.exports.formats import DTYPES, frame_bytes
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray, Picture, Probe
from ultragray.geometry.registration import Registration
from ultragray.rendering.contact import way_in
from ultragray.rendering.settings import Encoding, FrameSettings, Resolved, registration_field
from ultragray.samplers import (
    MAX_POSES,
    Assess,
    DrawnSampler,
    Sampler,
    TrainingSampler,
    assessed_poses,
)
from ultragray.samplers.confident import require_drawn
from ultragray.scene.confidence import Assessor, Extrapolation, require_confidence
from ultragray.scene.info import SceneHeader
from ultragray_workers.errors import StorageFull
from ultragray_workers.jobs.kinds.base import Specification, Surroundings, to_dict

ASSESSED_AT_ONCE = 250_000  # poses times training poses that submissions wait for: about a fifth of a second
_MEMBER_BYTES = 1024  # of a shard, around the pixels of a member
_MB, _GB = 1e6, 1e9

Poses: TypeAlias = FloatArray | list[list[list[float]]]  # [C, 4, 4] mm


@dataclass(frozen=True, eq=False)
class RenderJob(FrameSettings, Specification):
    """Many frames of a scene become one archive, or many, at `poses`, or at those that `sampler` makes.

    The sampler makes them of `poses`, or where none are given of the scene's training poses. Poses are kept as an array
    of exact ones: up to 100,000 of them would be millions of Python's objects. Where `below_min_confidence` is refuse,
    a sampler keeps to poses that have `min_confidence`, and `poses` without a sampler must all have it. Raises
    InvalidArgument, InvalidPose, InvalidProbe, InvalidImageSize, UnknownOutput.
    """

    scene: str = described("Name of a scene; NAME@SHA256, or NAME@ and 12 digits of it: with that content alone.")
    poses: Poses | None = described("4x4 matrices, mm, probe to scene.", None)
    sampler: Sampler | None = described("Makes poses of the given ones, else of the scene's training poses.", None)
    format: str | None = described(
        "tar: WebDataset; mcap: messages of ROS 2; dicom and plus (.igs.mha): bmode in uint8, true to scale. "
        "Default: npz; in shards tar.",
        None,
        choices=tuple(FORMATS),
    )
    dtype: str | None = described("Default: the format's own.", None, choices=DTYPES)
    shard_frames: int | None = described(
        "Frames of a file: the job becomes many files, which all workers make. Default: one file, above 100,000 frames "
        "5,000 in each.",
        None,
        low=1,
        high=MAX_POSES,
    )
    registration: str | None = registration_field()
    kind: Literal["render"] = kind_field("render")

    run_module = "ultragray_workers.jobs.kinds.render_run"
    needs_scene = "scene"
    needs_registration = "registration"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.poses is None and self.sampler is None:
            raise InvalidArgument("poses or sampler must be given", field="poses")
        if self.poses is None and self.registration is not None:
            raise InvalidArgument("poses must be given where a registration leads them", field="poses")
        if self.poses is not None and isinstance(self.sampler, TrainingSampler):
            raise InvalidArgument("poses must be left out where sampler is of kind training", field="poses")
        if self.poses is not None:
            is_many = isinstance(self.poses, (list, np.ndarray))
            length = len(self.poses) if is_many else self.poses
            if not is_many or not 1 <= len(self.poses) <= MAX_POSES:
                raise InvalidArgument(
                    f"poses must be a list of 1 to {MAX_POSES} 4x4 matrices, got {shown(length)}", field="poses"
                )
            object.__setattr__(self, "poses", check_poses(self.poses))
        if self.is_sharded and self.format not in (None, "tar"):
            raise InvalidArgument(f"format must be tar in shards, got {self.format}", field="format")
        object.__setattr__(self, "format", self.format or ("tar" if self.is_sharded else "npz"))
        check_format(self.file_format.name, self.outputs, self.dtype)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RenderJob) and to_dict(self) == to_dict(other)

    __hash__ = None  # type: ignore[assignment]

    def registered(self, registration: Registration) -> Self:
        return replace(self, poses=registration.probe_to_scene(np.asarray(self.poses)), registration=None)

    @classmethod
    def is_in_shards(cls, document: Mapping[str, Any]) -> bool:
        """Whether it asks for a number of frames in a file, or for more than one file holds."""
        sampler = document.get("sampler") or {}
        return document.get("shard_frames") is not None or (sampler.get("count") or 0) > MAX_POSES

    @property
    def is_sharded(self) -> bool:
        """Whether the frames become many files, which all workers make."""
        drawn = isinstance(self.sampler, DrawnSampler) and self.sampler.count > MAX_POSES
        return self.shard_frames is not None or drawn

    @property
    def file_format(self) -> Format:
        """The format of its file, or files."""
        return FORMATS[self.format or "npz"]

    def plan(self, scene: SceneHeader, scene_sha256: str) -> BatchPlan:
        return BatchPlan.prepared(
            scene,
            self,
            sampler=self.sampler,
            poses=None if self.poses is None else check_poses(self.poses),
            shard_frames=self.shard_frames,
            scene=self.scene,
            scene_sha256=scene_sha256,
            dtype=check_format(self.file_format.name, self.outputs, self.dtype),
        )

    def check(self, surroundings: Surroundings) -> None:
        """Raises UnknownOutput, InvalidProbe, InvalidImageSize; InvalidArgument for a sampler without use for the poses
        or a `min_confidence` or `contact` that the scene cannot tell; LowConfidence for a given pose below it, unless
        there are too many to look at each; StorageFull for more pixels than the disk has room for.
        """
        scene = surroundings.scene
        assert scene is not None
        settings = self.resolved(scene.info, Encoding.FLOAT32, max_image_side=surroundings.max_image_side)
        if self.breathing is not None:
            raise InvalidArgument("breathing is by the clock: frames of a job want a phase", field="breathing")
        if self.contact is not None:
            way_in(scene.training_poses, scene.info.probe)
        if self.is_sharded:
            frames = self._planned_frames(scene)
        else:
            frames = len(self.poses_of(scene.training_poses, settings.probe))
        if self.least_confidence is not None and self.sampler is None:
            poses = self.poses_of(scene.training_poses, settings.probe)
            if len(poses) * len(scene.training_poses) <= ASSESSED_AT_ONCE:
                assessor = Assessor(scene.info, scene.training_poses)
                require_confidence(assessor.assess(poses, settings.probe, phase=settings.phase), self.least_confidence)
        with under("display"):
            picture = self.file_format.shown(settings).picture
        if surroundings.free_bytes is not None:
            self.check_room(frames, picture, surroundings.free_bytes)

    def outlook(self, scene: SceneHeader, settings: Resolved, most: int) -> tuple[int, FloatArray]:
        """The number of its frames, whatever their confidence, and at most `most` poses [C, 4, 4], evenly spread.

        Of a batch that is drawn in shards, they are of its first block. Raises InvalidArgument as the job would.
        """
        if not self.is_sharded:
            poses = self.poses_of(scene.training_poses, settings.probe)
            return len(poses), poses[_spread(len(poses), most)]
        first = self.sampler.block(0) if isinstance(self.sampler, DrawnSampler) else self.sampler
        base = self._base(scene.training_poses)
        poses = base if first is None else first.poses(base, settings.probe)
        return self._planned_frames(scene), poses[_spread(len(poses), most)]

    def file_count(self, frames: int) -> int:
        """The number of files that so many frames become, the manifest of shards not counted."""
        return -(-frames // (self.shard_frames or SHARD_FRAMES)) if self.is_sharded else 1

    def file_bytes(self, frames: int, picture: Picture) -> int:
        """The most that so many frames take: their pixels, not compressed."""
        size = frame_bytes(self.outputs, check_format(self.file_format.name, self.outputs, self.dtype), picture)
        if self.is_sharded:  # blocks of the tar around the pixels, pose and figures of each frame
            size += _MEMBER_BYTES * (1 + len(self.outputs))
        return frames * size

    def _planned_frames(self, scene: SceneHeader) -> int:
        """The frames of a job in shards. Raises InvalidArgument where no shard could be made."""
        self._base(scene.training_poses)
        if self.least_confidence is not None and self.sampler is not None:
            require_drawn(self.sampler)
        return self.plan(scene, "").frames

    def poses_of(self, training_poses: FloatArray, probe: Probe) -> FloatArray:  # [P, 4, 4] -> [C, 4, 4] mm
        """The poses that the job asks for, whatever their confidence; the same training poses and probe give the same.

        Raises InvalidArgument where a sampler needs training poses and the scene has none, or cannot use those it has.
        """
        base = self._base(training_poses)
        return base if self.sampler is None else self.sampler.poses(base, probe)

    def assessed_poses(
        self, training_poses: FloatArray, probe: Probe, assess: Assess
    ) -> tuple[FloatArray, Sequence[Extrapolation]]:  # [P, 4, 4] -> [C, 4, 4] mm, [C]
        """The poses to render, each with its `least_confidence`, and what `assess` finds about each.

        Raises LowConfidence for a given pose below it and for a sampler that keeps too few, and what `poses_of` raises.
        """
        return assessed_poses(self.sampler, self._base(training_poses), probe, assess, self.least_confidence)

    def _base(self, training_poses: FloatArray) -> FloatArray:  # [P, 4, 4] -> [P, 4, 4]
        if self.poses is not None:
            return check_poses(self.poses)
        if not len(training_poses):
            raise InvalidArgument(f"sampler needs training poses, the scene {self.scene!r} has none", field="sampler")
        return training_poses

    def check_room(self, frames: int, picture: Picture, free: int) -> None:
        needed = self.file_bytes(frames, picture)
        if needed > free:
            raise StorageFull(
                f"{frames:,} frames of {picture.height}x{picture.width} take up to {_size(needed)}, the artifact "
                f"folder has {_size(free)} left",
                field="poses" if self.sampler is None else "sampler",
            )


def _spread(count: int, most: int) -> npt.NDArray[np.int64]:
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)


def _size(size_bytes: int) -> str:
    return f"{size_bytes / _MB:,.0f} MB" if size_bytes < _GB else f"{size_bytes / _GB:,.1f} GB"

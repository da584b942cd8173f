"""Scenes, as the service tells them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from ultragray_proto.codec import from_message
from ultragray_proto.v1 import scenes_pb2

from .contract import ElevationBeam, Probe
from .geometry import FloatArray

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
    owner: str | None  # None: nobody
    private: bool  # others do not see it


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
    )


@dataclass(frozen=True)
class _TrainingPoses:
    position_min_mm: Point
    position_max_mm: Point
    first: FloatArray
    middle: FloatArray
    last: FloatArray

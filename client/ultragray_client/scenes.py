"""Scenes as values, and what can be asked about them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ultragray_proto.v1 import geometry_pb2, scenes_pb2

from .confidence import ConfidenceFit, confidence_fit_from_message
from .connection import Operation
from .geometry import FloatArray, Probe, matrix_from_message, probe_from_message

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


@dataclass(frozen=True, eq=False)
class Scene:
    """What a scene says about itself; None, 0 or empty where it is not known."""

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
    training_poses: tuple[FloatArray, ...]  # the first, the middle and the last, each [4, 4] mm
    metrics: Mapping[str, float]
    dataset_name: str
    dataset_sha256: str
    label_names: Mapping[int, str]  # what the values of the output labels mean
    confidence: ConfidenceFit | None  # None: it cannot tell the confidence of its frames


def list_scenes(page_size: int, page_token: str) -> Operation[tuple[list[SceneEntry], str]]:
    request = scenes_pb2.ListScenesRequest(page_size=page_size, page_token=page_token)
    return Operation(
        "scenes.ListScenes",
        request,
        lambda answer: ([_entry(scene) for scene in answer.scenes], answer.next_page_token),
    )


def get_scene(name: str) -> Operation[Scene]:
    return Operation("scenes.GetScene", scenes_pb2.GetSceneRequest(scene=name), _scene)


def load_scene(name: str) -> Operation[int]:
    request = scenes_pb2.LoadSceneRequest(scene=name)
    return Operation("scenes.LoadScene", request, lambda answer: int(answer.loaded_processes))


def unload_scene(name: str) -> Operation[int]:
    request = scenes_pb2.UnloadSceneRequest(scene=name)
    return Operation("scenes.UnloadScene", request, lambda answer: int(answer.loaded_processes))


def _entry(message: scenes_pb2.SceneEntry) -> SceneEntry:
    return SceneEntry(
        name=message.name,
        loaded=message.loaded,
        gaussian_count=message.gaussian_count,
        image_height=message.image_height,
        image_width=message.image_width,
        file_bytes=message.file_bytes,
        error=message.error.detail if message.HasField("error") else None,
    )


def _scene(message: scenes_pb2.Scene) -> Scene:
    trained = message.training_poses
    known = trained.count > 0
    return Scene(
        name=message.name,
        loaded_processes=message.loaded_processes,
        file_bytes=message.file_bytes,
        gaussian_count=message.gaussian_count,
        sh_degree=message.sh_degree,
        intensity=message.intensity,
        centre_mm=_point(message.centre_mm),
        bounds_min_mm=_point(message.bounds_min_mm),
        bounds_max_mm=_point(message.bounds_max_mm),
        probe=probe_from_message(message.probe),
        image_height=message.image_height,
        image_width=message.image_width,
        training_pose_count=trained.count,
        training_position_min_mm=_point(trained.position_min_mm) if known else None,
        training_position_max_mm=_point(trained.position_max_mm) if known else None,
        training_poses=tuple(map(matrix_from_message, (trained.first, trained.middle, trained.last))) if known else (),
        metrics=dict(message.metrics),
        dataset_name=message.dataset_name,
        dataset_sha256=message.dataset_sha256,
        label_names=dict(message.label_names),
        confidence=confidence_fit_from_message(message.confidence) if message.HasField("confidence") else None,
    )


def _point(message: geometry_pb2.Position) -> Point:
    return (message.x, message.y, message.z)

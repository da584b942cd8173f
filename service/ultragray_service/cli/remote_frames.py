"""Frames that a running service renders, into a picture, an archive or a folder of PNGs."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ultragray.contract import from_dict, to_dict
from ultragray.errors import InvalidArgument
from ultragray.exchange.poses import load_poses
from ultragray.files import write_whole
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.rendering.settings import FrameSettings
from ultragray.samplers import Sampler
from ultragray_service.cli.connection import Connection, route
from ultragray_service.cli.terminal import OR_A_FOLDER, check_ending, check_file, check_folder, counted, is_folder_name

MEDIA_TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".npz": "application/x-npz"}
SUFFIXES = tuple(MEDIA_TYPES)
FRAMES_FILE = "frames.json"


@dataclass(frozen=True)
class RenderRequest:
    scene: str
    output: Path
    suffix: str | None  # of SUFFIXES; None: a folder of PNGs
    pose_file: Path | None
    sampler: Sampler | None
    registration: str | None  # that leads the poses of the file into the scene
    settings: FrameSettings

    def __post_init__(self) -> None:
        if self.registration is not None and (self.pose_file is None or self.sampler is not None):
            raise InvalidArgument(
                "a registration leads the poses of a file, which must be given with --poses and without --sampler; "
                "ultragray jobs submit render samples about such poses",
                field="registration",
            )


def checked_kind(output: Path, settings: FrameSettings, *, force: bool) -> str | None:
    """The ending of the output, of SUFFIXES; None for a folder.

    Raises InvalidArgument for an output that cannot or may not be written, and for a picture of several outputs.
    """
    if is_folder_name(output):
        check_folder(output, force=force)
        return None
    check_ending(output, SUFFIXES, otherwise=OR_A_FOLDER)
    check_file(output, force=force)
    if output.suffix != ".npz" and len(settings.outputs) != 1:
        raise InvalidArgument(
            f"a picture holds one output, got {', '.join(settings.outputs)}: write a .npz file or a folder",
            field="outputs",
        )
    return output.suffix


def render_remotely(connection: Connection, request: RenderRequest) -> dict[str, Any]:
    given = None if request.pose_file is None else load_poses(request.pose_file)
    poses = _poses(connection, request, given)
    settings = to_dict(request.settings, with_none=False)
    if request.registration is not None:
        settings["registration"] = request.registration
    if request.suffix is None:
        shape = _write_folder(connection, request, settings, poses)
    else:
        if request.suffix != ".npz" and len(poses) != 1:
            raise InvalidArgument(
                f"a picture holds one frame, there are {len(poses)} poses: write a .npz file or a folder",
                field="output",
            )
        body = {**settings, **({"pose": _pose(poses[0])} if len(poses) == 1 else {"poses": list(map(_pose, poses))})}
        answer = _rendered(connection, request.scene, body, MEDIA_TYPES[request.suffix])
        write_whole(request.output, answer.data)
        shape = answer.headers["x-ultragray-shape"]
    _, _, height, width = map(int, shape.split(","))
    return {
        "output": str(request.output),
        "scene": request.scene,
        "frames": len(poses),
        "height": height,
        "width": width,
        "outputs": list(request.settings.outputs),
    }


def _poses(connection: Connection, request: RenderRequest, given: FloatArray | None) -> FloatArray:  # [C, 4, 4] mm
    """The poses of a file, or those that a sampler makes; without either the middle training pose."""
    if request.sampler is None and given is not None:
        return given
    base = _training_poses(connection, request.scene) if given is None else given
    if not len(base):
        raise InvalidArgument("--poses must be given: the scene holds no training poses", field="poses")
    if request.sampler is None:
        middle: FloatArray = base[len(base) // 2][None]
        return middle
    probe = request.settings.probe
    if probe is None:
        document = connection.json("GET", route("scenes", request.scene))["probe"]
        if document is None:
            raise InvalidArgument("--probe must be given: the scene does not know its own", field="probe")
        probe = from_dict(Probe, document)
    return request.sampler.poses(base, probe)


def _write_folder(connection: Connection, request: RenderRequest, settings: dict[str, Any], poses: FloatArray) -> str:
    """A PNG for each pose and output, and a file that describes the frames; their shape as a header tells it."""
    shape, documents = "", []
    with counted("rendering", len(poses)) as report:
        for number, pose in enumerate(poses):
            for output in request.settings.outputs:
                body = {**settings, "outputs": [output], "pose": _pose(pose)}
                answer = _rendered(connection, request.scene, body, MEDIA_TYPES[".png"])
                request.output.mkdir(parents=True, exist_ok=True)  # only now: a refusal leaves no folder
                write_whole(request.output / f"frame_{number:05d}_{output}.png", answer.data)
                shape = answer.headers["x-ultragray-shape"]
            documents.append({"frame": number, "pose": answer.fact("pose"), **(answer.fact("extrapolation") or {})})
            report(number + 1)
    write_whole(request.output / FRAMES_FILE, json.dumps(documents))
    return shape


@dataclass(frozen=True)
class _Answer:
    data: bytes
    headers: dict[str, str]

    def fact(self, name: str) -> Any:
        text = self.headers.get(f"x-ultragray-{name}")
        return None if text is None else json.loads(text)


def _rendered(connection: Connection, scene: str, body: dict[str, Any], media_type: str) -> _Answer:
    with connection.open("POST", route("scenes", scene, "render"), body, accept=media_type) as answer:
        return _Answer(connection.whole(answer), {key.lower(): value for key, value in answer.headers.items()})


def _training_poses(connection: Connection, scene: str) -> FloatArray:  # [P, 4, 4] mm
    found = connection.json("GET", route("scenes", scene, "training-poses"))
    return check_poses(np.array(found["poses"], np.float64).reshape(-1, 4, 4))


def _pose(pose: FloatArray) -> dict[str, Any]:  # [4, 4] mm
    return {"matrix": pose.tolist()}

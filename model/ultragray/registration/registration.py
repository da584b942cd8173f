"""Registration: the two links of a chain that lead a robot's poses into a scene, and their file. Free of torch.

Convention. probe→scene = base→scene · flange→base · probe→flange, mm. For a tracked probe the base is the tracker, and
the flange the marker on the probe.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ultragray.contract import Contract, described, from_dict, to_dict
from ultragray.errors import InvalidArgument, InvalidPose
from ultragray.files.atomic import write_whole
from ultragray.files.format_version import require_version
from ultragray.pose import check_poses
from ultragray.probe import FloatArray

FORMAT_VERSION = 1
MAX_FILE_BYTES = 1 << 20

Row = tuple[float, float, float, float]
Rows = tuple[Row, Row, Row, Row]
_IDENTITY: Rows = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


@dataclass(frozen=True, kw_only=True)
class Registration(Contract):
    """How the frame of a robot or tracker lies to a scene's, and the probe to its flange or marker.

    Raises InvalidPose for what is not rigid, InvalidArgument.
    """

    base_to_scene: Rows = described("From the robot's base, or the tracker, to the scene: 4x4, mm.", error=InvalidPose)
    probe_to_flange: Rows = described(
        "From the probe to the flange, or the marker on it: 4x4, mm. Default: they are the same.",
        _IDENTITY,
        error=InvalidPose,
    )
    residual_mm: float | None = described("Root mean square; null: not known.", None, low=0.0, high=1e6)
    residual_deg: float | None = described("Likewise, of poses.", None, low=0.0, high=180.0)
    position_std_mm: tuple[float, float, float] | None = described(
        "Standard deviations of base_to_scene, where it was found; null: not known.", None, low=0.0, high=1e6
    )
    angle_std_deg: tuple[float, float, float] | None = described(
        "Of its turns, about the axes of the scene.", None, low=0.0, high=1e6
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("base_to_scene", "probe_to_flange"):
            exact = check_poses(getattr(self, name), field=name)[0]
            object.__setattr__(self, name, rows(exact))

    @cached_property
    def _links(self) -> tuple[FloatArray, FloatArray]:  # [4, 4] both
        return np.array(self.base_to_scene), np.array(self.probe_to_flange)

    def probe_to_scene(self, flange_to_base: FloatArray) -> FloatArray:  # [..., 4, 4] mm, exact -> [..., 4, 4]
        """The poses of the probe in the scene, of poses of the flange in the base."""
        base_to_scene, probe_to_flange = self._links
        poses: FloatArray = base_to_scene @ flange_to_base @ probe_to_flange
        return poses

    def marker_to_scene(self, marker_to_base: FloatArray) -> FloatArray:  # [..., 4, 4] mm, exact -> [..., 4, 4]
        """The poses in the scene of something else in the base than the probe, such as a needle's marker."""
        base_to_scene, _ = self._links
        poses: FloatArray = base_to_scene @ marker_to_base
        return poses

    def in_base(self, to_scene: FloatArray) -> FloatArray:  # [..., 4, 4] mm -> [..., 4, 4]
        """Transforms into the scene as such into the base."""
        base_to_scene, _ = self._links
        poses: FloatArray = np.linalg.inv(base_to_scene) @ to_scene
        return poses

    def flange_to_base(self, probe_to_scene: FloatArray) -> FloatArray:  # [..., 4, 4] mm, exact -> [..., 4, 4]
        """The poses of the flange in the base, of poses of the probe in the scene."""
        base_to_scene, probe_to_flange = self._links
        poses: FloatArray = np.linalg.inv(base_to_scene) @ probe_to_scene @ np.linalg.inv(probe_to_flange)
        return poses


def rows(pose: FloatArray) -> Rows:  # [4, 4]
    """A pose as the contract holds it."""
    first, second, third, fourth = ((float(a), float(b), float(c), float(d)) for a, b, c, d in pose)
    return first, second, third, fourth


def save_registration(path: str | Path, registration: Registration) -> None:
    """Writes the file of a registration, JSON, or leaves what was there."""
    document = {"format_version": FORMAT_VERSION, **to_dict(registration)}
    write_whole(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def load_registration(path: str | Path) -> Registration:
    """The registration of a file. Raises InvalidArgument, naming the file and what is wrong with it."""
    path = Path(path)
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise ValueError("it is larger than a registration is")
        document: Any = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(document, dict):
            raise ValueError("it holds no object")
        require_version(document.pop("format_version", None), FORMAT_VERSION)
        return from_dict(Registration, document)
    except (OSError, ValueError, RecursionError) as error:
        raise InvalidArgument(f"{path} is no registration that can be read: {error}", field="registration") from None

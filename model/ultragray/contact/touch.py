"""The contact of probes at poses with the skin, scan line by scan line."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ultragray.contact.skin import COUPLING_MM, Skin
from ultragray.pose import check_poses
from ultragray.probe import FloatArray, Probe


@dataclass(frozen=True, eq=False)
class Touch:
    """Where the W scan lines of C poses meet the skin. Made by `Touch.of`."""

    skin: Skin
    faces: FloatArray  # [C, W, 3] mm: where the lines leave the face
    directions: FloatArray  # [C, W, 3]

    @classmethod
    def of(cls, skin: Skin, probe: Probe, poses: FloatArray, width: int) -> Touch:  # [C, 4, 4] or [4, 4] mm
        """The contact of a probe, which need not be that of the training views. Raises InvalidPose."""
        exact = check_poses(poses)
        origins, directions = probe.scan_lines(width)
        turned = exact[:, :3, :3].transpose(0, 2, 1)
        faces = (origins + probe.face_depth_mm * directions) @ turned + exact[:, None, :3, 3]  # [C, W, 3]
        return cls(skin, faces, directions @ turned)

    @cached_property
    def gaps_mm(self) -> FloatArray:  # [C, W]
        """From the face to the skin at rest along the line; below 0: it is pressed, infinite: no skin is known."""
        return self.skin.gaps_mm(self.faces, self.directions)

    @cached_property
    def pressed_mm(self) -> FloatArray:  # [C]
        """How far the face lies beyond the innermost training face, a mean over the lines with contact; at least 0."""
        pressed = np.where(self.lines, self.skin.pressed_mm(self.faces, self.directions), 0.0).sum(axis=1)
        mean: FloatArray = pressed / np.maximum(self.lines.sum(axis=1), 1)
        return mean

    @property
    def lines(self) -> npt.NDArray[np.bool_]:  # [C, W]
        """The scan lines that have contact: their faces are not more than COUPLING_MM off the skin."""
        return self.gaps_mm <= COUPLING_MM

    @property
    def shares(self) -> FloatArray:  # [C]
        """The share of the scan lines of each pose that have contact, 0 to 1."""
        shares: FloatArray = self.lines.mean(axis=1)
        return shares

"""A needle: a shaft thinner than the beam, of which the middle line is seen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ultragray.contract import kind_field
from ultragray.pose import check_poses
from ultragray.probe import FloatArray, Probe
from ultragray.tools.crossing import Crossing, ScanView, covered, dot
from ultragray.tools.shaft import Shaft

_LEAST = 1e-12


@dataclass(frozen=True, kw_only=True)
class Needle(Shaft):
    """A straight needle. Its echo lies on the line from tip to hub, so that the tip is where it is said to be.

    Raises InvalidArgument for a hub at the tip.
    """

    kind: Literal["needle"] = kind_field("needle")

    def tip_in_image(self, probe: Probe, poses: Any) -> FloatArray:  # [C, 4, 4] or [4, 4] mm -> [C, 3]
        """Row and column of the tip, from 0 to 1 down and across the image, NaN outside it, and its elevation in mm.

        Raises InvalidPose.
        """
        tip = self.seen_by(ScanView(probe, check_poses(poses), 1), [self.tip_mm])[:, 0]
        rows, columns = probe.image_coordinates(tip[:, 0], tip[:, 2])
        return np.stack([rows, columns, tip[:, 1]], axis=-1)

    def crossing(self, view: ScanView) -> Crossing:
        """Of each line the point of the shaft that is nearest, as the beam sees it, which is thicker than it is wide.

        With q the way from the tip along the shaft, the gap across the line is a + b·q and the elevation y + v·q. The
        point is where (gap / radius)² + (elevation / σ)² is least, σ that of the slice. Half a line's width and the
        slice bound the part of the shaft around it that the line sees: all of a shaft that runs along it.
        """
        tip, hub = np.moveaxis(self.seen_by(view, (self.tip_mm, self.hub_mm)), 1, 0)[:, :, None]  # [C, 1, 3] each
        length = np.linalg.norm(hub - tip, axis=-1)  # [C, 1]
        shaft = (hub - tip) / length[..., None]
        origins, along, across = view.lines
        radius, face = 0.5 * self.diameter_mm, view.probe.face_depth_mm
        a, b = dot(tip - origins, across), dot(shaft, across)  # [C, W]
        y, v = tip[..., 1], shaft[..., 1]  # [C, 1]
        depth, deeper = dot(tip - origins, along), dot(shaft, along)
        low, high = _bounded(np.zeros_like(a), np.broadcast_to(length, a.shape), -deeper, depth - face)
        sigma = view.slice_mm(depth)
        curvature = (b / radius) ** 2 + (v / sigma) ** 2
        nearest = -(a * b / radius**2 + y * v / sigma**2) / np.maximum(curvature, _LEAST)
        q = np.clip(nearest, low, np.maximum(low, high))
        spacing, wider = view.spacing_mm(depth + deeper * q), view.turn * deeper
        half = np.maximum(radius * np.abs(v), 0.5 * spacing)
        # Half a line more where the shaft runs along it: its end there is no edge of the shaft.
        steep = 1.0 - np.abs(b)
        inside = np.abs(b) * np.minimum(nearest - low, high - nearest) + 0.5 * spacing * steep
        off = np.maximum(np.abs(y + v * q) - radius, 0.0)
        cover = (
            covered(np.abs(a + b * nearest), half, spacing)
            * covered(-inside, 0.0, spacing)
            * np.exp(-0.5 * (off / sigma) ** 2)
        )
        # The part that is seen: |gap| ≤ room + q·widening, as lines of a fan are wider farther out.
        room = half + 0.5 * steep * spacing - 0.5 * (1.0 + steep) * wider * q
        widening = 0.5 * (1.0 + steep) * wider
        first_q, last_q = _bounded(low, high, b - widening, room - a)
        first_q, last_q = _bounded(first_q, last_q, -b - widening, room + a)
        reach = sigma / np.maximum(np.abs(v), _LEAST)
        first_q = np.minimum(np.maximum(first_q, q - reach), q)
        last_q = np.maximum(np.minimum(last_q, q + reach), q)
        ends = depth + deeper * first_q, depth + deeper * last_q
        first, last = np.minimum(*ends), np.maximum(*ends)
        path = np.minimum(self.diameter_mm / np.sqrt(np.maximum(1.0 - deeper**2, _LEAST)), length + self.diameter_mm)
        # The shaft's own thickness along the line, but not beyond its ends.
        at = depth + deeper * q
        to_tip, to_hub = (way / np.maximum(np.abs(deeper), _LEAST) for way in (q, length - q))
        above, below = np.where(deeper >= 0.0, to_tip, to_hub), np.where(deeper >= 0.0, to_hub, to_tip)
        return Crossing(
            cover=np.where(low <= high, cover, 0.0)[None],
            first_mm=first[None],
            last_mm=last[None],
            filled_mm=np.zeros_like(path)[None],
            own_first_mm=np.maximum(np.minimum(first, at - np.minimum(0.5 * path, above)), face)[None],
            own_last_mm=np.maximum(last, at + np.minimum(0.5 * path, below))[None],
            path_mm=path[None],
            slant=np.minimum(np.abs(deeper), 1.0)[None],
            stopped=self.stopped(path)[None],
        )


def _bounded(low: FloatArray, high: FloatArray, slope: FloatArray, most: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The part of low ≤ q ≤ high where slope·q ≤ most; low > high where there is none."""
    limit = most / np.where(np.abs(slope) < _LEAST, _LEAST, slope)
    low = np.where(slope <= -_LEAST, np.maximum(low, limit), low)
    return low, np.where(slope > -_LEAST, np.minimum(high, limit), high)

"""register_frames(): base→scene from a few real frames and the robot's poses at them, found from the images alone.

Each frame is looked for in the scene about where the start puts it. The frames that are found vote: of the transforms
that each implies, the one counts that the others agree with best (the least median of residuals, Rousseeuw 1984), and
frames far from it are outliers. Frames that were not found, or are outliers, are looked for once more from there. At
last one motion of all frames that agree is found by all their images at once (`search.move_together`): the robot knows
better how they lie to each other than each image knows where it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.geometry.registration import LEVER_MM, PoseFit, pose_residuals, register_poses
from ultragray.learn.localization.search import localize, move_together
from ultragray.learn.localization.settings import NEAR_DEG, NEAR_MM, Localization
from ultragray.scene.gaussians import GaussianScene

LEAST_FRAMES = 3
OUTLIER = 3.0  # times the median residual
LEAST_OUTLIER_MM = 0.5  # what is closer is none

BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class FrameFit:
    """A registration from frames: the fit of those that agree, and which ones these are."""

    fit: PoseFit  # of the frames in `agreeing`, in their order
    agreeing: tuple[int, ...]  # numbers of frames
    localizations: tuple[Localization, ...]  # of all frames


def register_frames(
    scene: GaussianScene,
    images: Sequence[Any],  # each [H, W], see localize()
    flange_to_base: Any,  # [N, 4, 4] mm, at the frames
    start: Any,  # [4, 4] mm, base→scene that is about right
    *,
    probe_to_flange: Any = None,  # [4, 4] mm
    probe: Probe | None = None,
    within_mm: float = NEAR_MM,
    within_deg: float = NEAR_DEG,
    backend: str = "auto",
) -> FrameFit:
    """base→scene by which the frames lie where the robot says that they were taken.

    `start` may be off by as much as puts the frames `within_mm` and `within_deg` off.
    Raises InvalidArgument for less than three frames, and where less than three of them, or not more than half, agree;
    and what localize() raises.
    """
    flanges = check_poses(flange_to_base, field="flange_to_base")
    if len(images) != len(flanges) or len(images) < LEAST_FRAMES:
        raise InvalidArgument(
            f"images must be {LEAST_FRAMES} or more, each with a pose of the flange, got {len(images)} images and "
            f"{len(flanges)} poses",
            field="images",
        )
    mounting = np.eye(4) if probe_to_flange is None else check_poses(probe_to_flange, field="probe_to_flange")[0]
    first = check_poses(start, field="start")[0]
    in_base = flanges @ mounting

    def search(base_to_scene: FloatArray, index: int) -> Localization:
        return localize(
            scene,
            images[index],
            base_to_scene @ in_base[index],
            probe=probe,
            within_mm=within_mm,
            within_deg=within_deg,
            backend=backend,
        )

    localizations = [search(first, index) for index in range(len(images))]
    agreeing = _agreeing(in_base, localizations)
    fit = _fit_of(flanges, localizations, agreeing, mounting)
    for index in np.flatnonzero(~agreeing):
        localizations[index] = search(fit.base_to_scene, int(index))
    agreeing = _agreeing(in_base, localizations)
    fit = _fit_of(flanges, localizations, agreeing, mounting)
    chosen = np.flatnonzero(agreeing)
    placed = fit.base_to_scene @ in_base[chosen]
    motion = move_together(scene, [images[index] for index in chosen.tolist()], placed, probe=probe, backend=backend)
    joint = motion @ fit.base_to_scene
    residuals = pose_residuals(
        joint @ in_base[chosen], np.stack([localizations[index].pose for index in chosen.tolist()])
    )
    fit = replace(fit, base_to_scene=joint, residuals_mm=residuals[0], residuals_deg=residuals[1])
    return FrameFit(fit, tuple(int(index) for index in np.flatnonzero(agreeing)), tuple(localizations))


def _agreeing(in_base: FloatArray, localizations: Sequence[Localization]) -> BoolArray:  # [N, 4, 4] -> [N]
    """Which frames agree with the transform that most of those that were found agree with. Raises InvalidArgument."""
    is_found = np.array([one.is_found for one in localizations])
    poses = np.stack([one.pose for one in localizations])
    if is_found.sum() < LEAST_FRAMES:
        raise InvalidArgument(
            f"{is_found.sum()} of {len(poses)} frames were found in the scene, and {LEAST_FRAMES} are needed: a start "
            "that is closer, or a larger within_mm, may help",
            field="images",
        )
    implied = [poses[index] @ np.linalg.inv(in_base[index]) for index in np.flatnonzero(is_found)]
    apart = (pose_residuals(base_to_scene @ in_base, poses) for base_to_scene in implied)
    votes = [np.hypot(shifts_mm, LEVER_MM * np.radians(turns_deg)) for shifts_mm, turns_deg in apart]
    medians = [float(np.median(vote[is_found])) for vote in votes]
    best = votes[int(np.argmin(medians))]
    agreeing = is_found & (best <= max(LEAST_OUTLIER_MM, OUTLIER * min(medians)))
    if agreeing.sum() < LEAST_FRAMES or 2 * agreeing.sum() <= is_found.sum():
        raise InvalidArgument(
            f"of {is_found.sum()} frames that were found only {agreeing.sum()} agree with each other: are the poses "
            "those of the images, and is the probe mounted as probe_to_flange says?",
            field="images",
        )
    return agreeing


def _fit_of(
    flanges: FloatArray, localizations: Sequence[Localization], agreeing: BoolArray, mounting: FloatArray
) -> PoseFit:
    poses = np.stack([one.pose for one in localizations])
    return register_poses(flanges[agreeing], poses[agreeing], mounting)

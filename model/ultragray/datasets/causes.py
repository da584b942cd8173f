"""What is wrong with the poses of a sweep, by the path that its frames agree with (`learn.training.agreement`), in
numbers and in words. `checks` calls it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ultragray.geometry.probe import Probe
from ultragray.geometry.rotations import turn_angles_rad
from ultragray.learn.training.agreement import RIGID, AgreedPath, Shares

SHAKEN_DB = 1.0  # by which frames must be predicted better in time than in space


@dataclass(frozen=True)
class PathReport:
    """What a training takes off the poses before it begins. Frames are predicted by the two beside them, mean PSNR."""

    causes: tuple[str, ...]  # those found of: shaking, delay, calibration, tissue, uneven, wander
    in_time_db: float  # pixel by pixel, whatever the poses say
    tracked_db: float  # in space, as tracked
    found_db: float  # in space, without what was found
    noise_mm: float  # of the tracker from frame to frame, as its path alone tells it
    noise_deg: float
    noise_axes_mm: tuple[float, float, float]  # lateral, elevation (with what the hand goes unevenly), axial
    delay_ms: float  # of the images to their poses; negative: they are earlier
    calibration_mm: float  # by which it is off in the middle of the image
    calibration_deg: float
    tissue_shares: Shares  # of the motion within the plane that images show: lateral, axial, turn
    crossing_before: float | None  # correlation of passes that cross; None: they agree, or none cross
    crossing_after: float | None  # with the motions found
    crossing_mm: float | None  # of these motions, root mean square
    warnings: tuple[str, ...]  # a sentence for each cause

    @classmethod
    def of(cls, path: AgreedPath, probe: Probe) -> PathReport:
        """Of the path of frames of this probe."""
        middle, crossing = np.append(probe.corners_mm().mean(axis=0), 1.0), path.crossing
        shift_mm = float(np.linalg.norm(path.calibration @ middle - middle))
        turn_deg = float(np.degrees(turn_angles_rad(path.calibration[:3, :3], np.eye(3))))
        texts = dict(_causes(path, shift_mm, turn_deg))
        return cls(
            causes=tuple(texts),
            in_time_db=path.in_time_db,
            tracked_db=path.tracked_db,
            found_db=path.found_db,
            noise_mm=path.noise.position_mm,
            noise_deg=path.noise.turn_deg,
            noise_axes_mm=path.noise.axes_mm,
            delay_ms=1000.0 * path.delay_s,
            calibration_mm=shift_mm,
            calibration_deg=turn_deg,
            tissue_shares=path.shares,
            crossing_before=None if crossing is None else crossing.before,
            crossing_after=None if crossing is None else crossing.after,
            crossing_mm=None if crossing is None else crossing.shift_mm,
            warnings=(*_predicted(path, bool(texts)), *texts.values()),
        )


def _predicted(path: AgreedPath, has_causes: bool) -> Iterator[str]:
    """Whether neighbours in time predict frames better, and what a training makes of that."""
    gain_db = path.found_db - path.tracked_db
    found = f"a training regains {gain_db:.1f} dB" if has_causes else "none of the known causes was found"
    if path.in_time_db >= path.tracked_db + SHAKEN_DB:
        better_db = path.in_time_db - path.tracked_db
        yield f"the two neighbours in time predict a frame {better_db:.1f} dB better than by their poses; {found}"


def _causes(path: AgreedPath, calibration_mm: float, calibration_deg: float) -> Iterator[tuple[str, str]]:
    """The causes, and each in a sentence."""
    if path.is_smoothed:
        lateral_mm, elevation_mm, axial_mm = path.noise.axes_mm
        yield (
            "shaking",
            f"the tracker shakes: from frame to frame it errs by {path.noise.position_mm:.2g} mm and "
            f"{path.noise.turn_deg:.2g}°, by its path alone (laterally {lateral_mm:.2g}, axially {axial_mm:.2g}, in "
            f"elevation at most {elevation_mm:.2g} mm); a training smooths it",
        )
    if path.delay_s:
        delay_ms = 1000.0 * path.delay_s
        side, other = ("later", "before") if delay_ms > 0 else ("earlier", "after")
        yield (
            "delay",
            f"images seem to be {abs(delay_ms):.0f} ms {side} than their poses: with poses of that time {other}, "
            f"neighbouring frames predict each other best (a training takes it off, --image-delay-ms {delay_ms:.0f} as "
            "well)",
        )
    if calibration_mm or calibration_deg:
        yield (
            "calibration",
            f"the calibration from the image to the probe seems to be off by {calibration_mm:.1f} mm in the middle of "
            f"the image and {calibration_deg:.1f}°: with another one, which a training takes, sweeps that cross agree "
            "better",
        )
    if path.shares != RIGID:
        lateral, axial, turn = path.shares
        yield (
            "tissue",
            f"tissue goes along with the probe, or the tracker errs within the image plane: of the motion there images "
            f"show {lateral:.0%} laterally, {axial:.0%} axially and {turn:.0%} of the turn, which a training takes",
        )
    if path.is_evened:
        yield (
            "uneven",
            "frames predict each other better from an even path, which a training takes: images have inexact times, or "
            "the tracker repeats poses",
        )
    if (crossing := path.crossing) is not None:
        yield (
            "wander",
            "passes that cross do not fit: what one shows and another predicts has a correlation of "
            f"{crossing.before:.2f}; the tracker wanders, or tissue was pressed (a training moves frames smoothly, by "
            f"{crossing.shift_mm:.1f} mm root mean square, which raises it to {crossing.after:.2f})",
        )

"""The error of a shown frame's pose, with the newest pose and with a foretold one: `make prediction`.

Beside both stands what the best linear predictor would have left, which nobody has before the path is over: the shares
of the last steps between poses, the same along all axes, that fit the whole path best. Where it leaves much, the path
cannot be foretold from its own past.

Frames are seen 20 to 1,000 ms after their poses were measured, each time 30% earlier or later at random. Paths are
those of simulated hands whose truth is known, of a robot that scans a raster, and recorded ones, whose truth between
two poses is taken as straight.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from measuring import Document, Lines, columns, measure_runs
from ultragray.datasets.source import SourceOptions, load_dataset
from ultragray.geometry.motion import PathPredictor
from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import blended, rotations_of, turns_of
from ultragray_studies.hand import MARGIN_S, Hand

AHEAD_MS = (20, 50, 100, 300, 1000)
JITTER = 0.3  # share of the time ahead
STEPS, POSES_A_STEP = 24, 8  # between poses, that the best linear predictor weighs: one for so many poses, at most
SECONDS = 15.0  # of a simulated path
ROBOT_MM_PER_S, ROBOT_WAY_MM, ROBOT_TURN_S = 20.0, 60.0, 0.5
ROBOT_NOISE = 0.02  # mm and degrees, of its encoders and the tracker of its base

Poses = Callable[[FloatArray], FloatArray]  # [N] s -> [N, 4, 4] mm
Path_ = tuple[FloatArray, FloatArray, Poses]  # times [N] and poses [N, 4, 4] as measured, and the truth


def hand(rate_hz: float, noise: float, _: Path) -> Path_:
    """A hand that sways and trembles, with white noise of so many mm and degrees."""
    truth = Hand(np.random.default_rng(0), int((SECONDS + 2 * MARGIN_S) / 0.05), 0.0).poses
    return measured_at(rate_hz, noise, truth)


def robot(_: Path) -> Path_:
    """A robot that goes to and fro in straight lines, turning back within half a second."""

    def truth(times_s: FloatArray) -> FloatArray:
        ticks = np.arange(0.0, SECONDS + 2 * MARGIN_S, 0.001)
        period_s = ROBOT_WAY_MM / ROBOT_MM_PER_S + ROBOT_TURN_S
        into = ticks % (2 * period_s)
        slope = np.clip((period_s - np.abs(into - period_s) - ROBOT_TURN_S / 2) / (ROBOT_TURN_S / 2), -1.0, 1.0)
        way = np.cumsum(np.where(into < period_s, 1.0, -1.0) * np.abs(slope) * ROBOT_MM_PER_S * 0.001)
        poses = np.tile(np.eye(4), (len(times_s), 1, 1))
        poses[:, 1, 3] = np.interp(times_s, ticks, way)
        poses[:, :3, :3] = rotations_of(np.radians(np.outer(poses[:, 1, 3] / 10.0, (1.0, 0.0, 0.0))))
        return poses

    return measured_at(125.0, ROBOT_NOISE, truth)


def recorded(name: str, device_set: str, data_folder: Path) -> Path_:
    """A sequence of PLUS, with the frames that a training holds out."""
    source = data_folder / name
    dataset = load_dataset(str(source), SourceOptions(device_set=source.with_name(device_set)))
    parts = (dataset.train, dataset.val)
    times_s, poses = (np.concatenate([getattr(part, of) for part in parts]) for of in ("times_s", "poses"))
    order = np.argsort(times_s)
    return times_s[order], poses[order], partial(straight, times_s[order], poses[order])


def measured_at(rate_hz: float, noise: float, truth: Poses) -> Path_:
    random, times_s = np.random.default_rng(1), np.arange(0.0, SECONDS, 1.0 / rate_hz)
    poses = truth(times_s)
    poses[:, :3, 3] += random.normal(scale=noise, size=(len(poses), 3))
    poses[:, :3, :3] @= rotations_of(np.radians(random.normal(scale=noise, size=(len(poses), 3))))
    return times_s, poses, truth


def straight(times_s: FloatArray, poses: FloatArray, at_s: FloatArray) -> FloatArray:  # [C, 4, 4]
    place = np.clip(np.searchsorted(times_s, at_s), 1, len(times_s) - 1)
    shares = (at_s - times_s[place - 1]) / (times_s[place] - times_s[place - 1])
    result = poses[place - 1] + shares[:, None, None] * (poses[place] - poses[place - 1])
    result[:, :3, :3] = blended(poses[place - 1, :3, :3], poses[place, :3, :3], shares)
    return result


def measure(take: Callable[[Path], Path_], data_folder: Path) -> Document:
    times_s, poses, truth = take(data_folder)
    return {"poses": len(poses), "ahead": {str(ms): errors(times_s, poses, truth, ms / 1e3) for ms in AHEAD_MS}}


def errors(times_s: FloatArray, poses: FloatArray, truth: Poses, ahead_s: float) -> Document:
    """Root mean square errors without and with prediction, and the ones that were told beside the frames."""
    seen_s = times_s + ahead_s * np.random.default_rng(2).uniform(1 - JITTER, 1 + JITTER, size=len(times_s))
    path, foretold, expected = PathPredictor(), [], []
    for time_s, pose, at_s in zip(times_s, poses, seen_s, strict=True):
        path.observe(time_s, pose)
        there, prediction = path.predict(at_s)
        foretold.append(there)
        expected.append((prediction.error_mm or 0.0, prediction.error_deg or 0.0))
    known = seen_s <= times_s[-1]
    if not known.any():
        return {}
    true = truth(seen_s[known])
    return {
        "without": rms(poses[known], true),
        "with": rms(np.stack(foretold)[known], true),
        "told": np.sqrt(np.square(expected)[known].mean(axis=0)).tolist(),
        "at_best": at_best(times_s, poses, seen_s, truth),
    }


def at_best(times_s: FloatArray, poses: FloatArray, seen_s: FloatArray, truth: Poses) -> list[float]:
    """Root mean square errors, mm and degrees, of the best linear predictor in hindsight."""
    known = seen_s <= times_s[-1]
    true, rotations = truth(seen_s[known]), poses[:, :3, :3]
    walked = np.diff(poses[:, :3, 3], axis=0), turns_of(rotations[:-1].transpose(0, 2, 1) @ rotations[1:])
    motions = true[:, :3, 3] - poses[known, :3, 3], turns_of(rotations[known].transpose(0, 2, 1) @ true[:, :3, :3])
    steps, residuals = max(1, min(STEPS, len(true) // POSES_A_STEP)), []
    for moves, right in zip(walked, motions, strict=True):
        speeds = np.concatenate([np.zeros((steps, 3)), moves / np.diff(times_s)[:, None]])  # none before the first pose
        last = np.stack([speeds[steps - back :][: len(poses)] for back in range(1, steps + 1)], axis=-1)  # [N, 3, S]
        foretold = (last * (seen_s - times_s)[:, None, None])[known].reshape(-1, steps)
        shares = np.linalg.lstsq(foretold, right.ravel(), rcond=None)[0]
        residuals.append(float(np.sqrt(np.square(right.ravel() - foretold @ shares).sum() / len(true))))
    return [residuals[0], float(np.degrees(residuals[1]))]


def rms(poses: FloatArray, true: FloatArray) -> list[float]:  # mm, degrees
    shifts = np.linalg.norm(poses[:, :3, 3] - true[:, :3, 3], axis=1)
    turns = np.linalg.norm(turns_of(poses[:, :3, :3].transpose(0, 2, 1) @ true[:, :3, :3]), axis=1)
    return [float(np.sqrt(np.square(shifts).mean())), float(np.degrees(np.sqrt(np.square(turns).mean())))]


def foretold_poses(runs: Document) -> Lines:
    """Errors by path and time ahead."""
    text = (
        "{without[0]:.2f} → {with[0]:.2f} ({at_best[0]:.2f}) mm, {without[1]:.2f} → {with[1]:.2f} ({at_best[1]:.2f})°"
    )
    rows = (
        {"path": name, **{f"in {ms}": text.format_map(one) if one else "–" for ms, one in run["ahead"].items()}}
        for name, run in runs.items()
    )
    return columns(rows, {"Path": "{path}", **{f"{ms:,} ms": f"{{in {ms}}}" for ms in AHEAD_MS}})


RUNS = {
    **{
        f"hand, {rate_hz} Hz, noise {noise:g}": partial(hand, rate_hz, noise)
        for rate_hz in (20, 60)
        for noise in (0.0, 0.05, 0.13)
    },
    "robot, 125 Hz": robot,
    "recorded hand on bone, 12 Hz": partial(
        recorded, "plus_freehand/BoneUltrasound_L14.igs.mha", "BoneUltrasound_L14_config.xml"
    ),
    "recorded hand on a phantom, 11 Hz": partial(
        recorded,
        "plus_original/SpinePhantomFreehand.igs.mha",
        "PlusDeviceSet_SpinePhantomFreehandReconstructionOnly.xml",
    ),
    "recorded hand on wires, 13 Hz": partial(
        recorded,
        "plus_original/fCal_Test_Calibration_3NWires_fCal2.0.igs.mha",
        "PlusDeviceSet_fCal_Sim_VolumeReconstruction.xml",
    ),
}

if __name__ == "__main__":
    measure_runs("prediction", __doc__, {name: partial(measure, take) for name, take in RUNS.items()}, threads=1)

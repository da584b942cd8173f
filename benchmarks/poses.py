"""Pose refinement of recorded sets whose training poses were given errors: `make poses`."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from measuring import Document, Lines, measure_runs, table
from ultragray.datasets.source import load_dataset
from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import about_axes, random_directions, rotation_angles_deg
from ultragray.learn.sweep import Sweep
from ultragray.learn.training import TrainingConfig
from ultragray.learn.training.alignment import sweep_ranges
from ultragray_studies.report import train_and_evaluate

SHAKEN, MOVED, RECORDED = "each frame by 1 mm and 1°", "the second sweep by 8 mm and 4°", "poses as recorded"
CASES = (  # sets, and the errors that are added
    ("ultranerf_liver", RECORDED),
    ("ultranerf_liver", SHAKEN),
    ("ultranerf_liver", MOVED),
    ("spine_phantom", RECORDED),
    ("spine_phantom", SHAKEN),
    ("liver_convex", RECORDED),
    ("nwire_phantom", RECORDED),
)


def measure(name: str, error: str, seed: int, data_folder: Path) -> Document:
    """Two trainings from the same poses, one that refines them; what is left of the errors after the second."""
    dataset = load_dataset(data_folder / name)
    true = dataset.train
    start = replace(true, poses=with_errors(true, error, seed))
    scores, refined = {}, start.poses
    for mode in ("none", "frames"):
        config = TrainingConfig.preset("fast", refine_poses=mode, confidence=False, seed=seed)
        trained = train_and_evaluate(replace(dataset, train=start), config)
        mean = trained.evaluation.mean
        scores[mode] = {"psnr_db": mean.psnr_db, "ms_ssim": mean.ms_ssim, "seconds": round(trained.course.seconds)}
        refined = trained.scene.training_poses
    return {
        **{f"{key}_{mode}": value for mode, score in scores.items() for key, value in score.items()},
        "added": deviation(true, start.poses),
        "left": deviation(true, refined),
    }


def with_errors(sweep: Sweep, error: str, seed: int) -> FloatArray:  # [F, 4, 4] mm
    """The poses of a sweep, each moved and turned about the middle of its image."""
    random = np.random.default_rng(seed)
    count = len(sweep)
    if error == RECORDED:
        return sweep.poses
    if error == SHAKEN:
        shifts_mm = random.normal(0.0, 1.0 / np.sqrt(3.0), (count, 3))
        turns_deg = random.normal(0.0, 1.0 / np.sqrt(3.0), (count, 3))
        middles = sweep.corners_mm().mean(axis=1)
    else:
        second = np.isin(np.arange(count), sweep_ranges(sweep)[1])[:, None]
        shifts_mm, turns_deg = (second * size * random_directions(random, 1) for size in (8.0, 4.0))
        middles = np.tile(sweep.corners_mm()[second[:, 0]].mean(axis=(0, 1)), (count, 1))
    angles = np.linalg.norm(turns_deg, axis=1)
    turns = about_axes(turns_deg / np.maximum(angles, 1e-12)[:, None], np.radians(angles))
    poses = sweep.poses.copy()
    poses[:, :3, :3] = turns @ poses[:, :3, :3]
    poses[:, :3, 3] = np.einsum("fij,fj->fi", turns, poses[:, :3, 3] - middles) + middles + shifts_mm
    return poses


def deviation(true: Sweep, poses: FloatArray) -> dict[str, float]:
    """Root mean square shift of the middles of the images and turn, less the one motion that fits all corners best."""
    corners = replace(true, poses=poses).corners_mm()
    points, targets = corners.reshape(-1, 3), true.corners_mm().reshape(-1, 3)
    left, _, right = np.linalg.svd((points - points.mean(axis=0)).T @ (targets - targets.mean(axis=0)))
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    turn = (left @ mirror @ right).T
    moved = (corners - points.mean(axis=0)) @ turn.T + targets.mean(axis=0)
    shifts = np.linalg.norm((moved - true.corners_mm()).mean(axis=1), axis=-1)
    turned = poses.copy()
    turned[:, :3, :3] = turn @ poses[:, :3, :3]
    turns = np.array([rotation_angles_deg(a[None], b[None])[0, 0] for a, b in zip(turned, true.poses, strict=True)])
    return {"mm": float(np.sqrt(np.square(shifts).mean())), "deg": float(np.sqrt(np.square(turns).mean()))}


RUNS = {f"{name}, {error}, seed 0": partial(measure, name, error, 0) for name, error in CASES}


def refined_poses(figures: Document) -> Lines:
    """Trainings from poses with errors, with and without refinement."""
    rows = []
    for name, error in CASES:
        runs = [run for key, run in figures.items() if key.startswith(f"{name}, {error}, ")]
        if not runs:
            continue
        mean = {
            key: float(np.mean([run[key] for run in runs])) for key in runs[0] if "_none" in key or "_frames" in key
        }
        scores = (f"{mean[f'psnr_db_{mode}']:.2f} dB / {mean[f'ms_ssim_{mode}']:.3f}" for mode in ("none", "frames"))
        added_mm, added_deg, left_mm, left_deg = (
            float(np.mean([run[which][unit] for run in runs])) for which in ("added", "left") for unit in ("mm", "deg")
        )
        removed = f"{1 - left_mm / added_mm:.0%}, {1 - left_deg / added_deg:.0%}" if error != RECORDED else ""
        seeds = f" ({len(runs)} seeds)" if len(runs) > 1 else ""
        rows.append((name, f"{error}{seeds}", *scores, f"{left_mm:.2f} mm, {left_deg:.2f}°", removed))
    head = ("set", "errors", "PSNR and MS-SSIM without refinement", "with it", "error left over", "removed")
    return table(head, rows)


if __name__ == "__main__":
    measure_runs("poses", __doc__, RUNS)

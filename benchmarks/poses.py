"""Pose refinement of recorded sets whose training poses were given errors.

    python benchmarks/poses.py DATA_FOLDER [--only NAME ...] [--seeds N]

The figures of a training go into build/bench/poses.json as soon as it is done. The table of docs/poses.md comes from
it.
"""

from __future__ import annotations

import argparse
import json
import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from registry import FIGURES, Document
from ultragray.datasets.source import load_dataset
from ultragray.files import write_whole
from ultragray.geometry.pose import rotation_angles_deg
from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import about_axes, random_directions
from ultragray.learn.sweep import Dataset, Sweep
from ultragray.learn.training import TrainingConfig
from ultragray.learn.training.alignment import sweep_ranges
from ultragray_studies.bench.report import measured
from ultragray_studies.report import train_and_evaluate

OUTPUT = FIGURES["poses"].staged
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

log = logging.getLogger("poses")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("data_folder", type=Path, help="folder of the data sets")
    parser.add_argument("--only", nargs="+", help="names of sets")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--threads", type=int, default=0, help="0: all cores")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    for name, error in CASES:
        if arguments.only is None or name in arguments.only:
            dataset = load_dataset(arguments.data_folder / name)
            for seed in range(arguments.seeds if error != RECORDED else 1):
                found = measure(dataset, error, seed)
                log.info("%s, %s, seed %d: %s", name, error, seed, found)
                figures = {**read(), f"{name}, {error}, seed {seed}": found}
                OUTPUT.parent.mkdir(parents=True, exist_ok=True)
                write_whole(OUTPUT, json.dumps(figures, indent=1, allow_nan=False) + "\n")


def read() -> dict[str, Any]:
    """Figures by set, error and seed."""
    return json.loads(OUTPUT.read_text()) if OUTPUT.exists() else {}


def measure(dataset: Dataset, error: str, seed: int) -> dict[str, Any]:
    """Two trainings from the same poses, one that refines them; what is left of the errors after the second."""
    head, true = measured(torch.get_num_threads()), dataset.train
    given = replace(true, poses=with_errors(true, error, seed))
    scores, refined = {}, given.poses
    for mode in ("none", "frames"):
        config = TrainingConfig.preset("fast", refine_poses=mode, confidence=False, seed=seed)
        trained = train_and_evaluate(replace(dataset, train=given), config)
        mean = trained.evaluation.mean
        scores[mode] = {"psnr_db": mean.psnr_db, "ms_ssim": mean.ms_ssim, "seconds": round(trained.course.seconds)}
        refined = trained.scene.training_poses
    return {
        **{f"{key}_{mode}": value for mode, score in scores.items() for key, value in score.items()},
        "added": deviation(true, given.poses),
        "left": deviation(true, refined),
        "measured": head,
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


def table(figures: Document) -> Iterator[str]:
    """The Markdown of what was measured."""
    yield "| set | errors | PSNR and MS-SSIM without refinement | with it | error left over | removed |"
    yield "|---|---|---|---|---|---|"
    for name, error in CASES:
        runs = [run for key, run in figures.items() if key.startswith(f"{name}, {error}, ")]
        if not runs:
            continue
        scores = [
            f"{_mean(runs, f'psnr_db_{mode}'):.2f} dB / {_mean(runs, f'ms_ssim_{mode}'):.3f}"
            for mode in ("none", "frames")
        ]
        added_mm, added_deg, left_mm, left_deg = (
            float(np.mean([run[which][unit] for run in runs])) for which in ("added", "left") for unit in ("mm", "deg")
        )
        removed = f"{1 - left_mm / added_mm:.0%}, {1 - left_deg / added_deg:.0%}" if error != RECORDED else ""
        seeds = f" ({len(runs)} seeds)" if len(runs) > 1 else ""
        yield f"| {name} | {error}{seeds} | {' | '.join(scores)} | {left_mm:.2f} mm, {left_deg:.2f}° | {removed} |"


def _mean(runs: Sequence[dict[str, Any]], key: str) -> float:
    return float(np.mean([run[key] for run in runs]))


if __name__ == "__main__":
    main()

"""Half the frames, planned, against an even raster, on the phantom: `make plan`.

A robot may hold the probe anywhere over a field of the phantom's skin, tilted by up to 12° to either side. It scans an
even raster, its lanes overlapping by half or side by side; or it begins with a few frames, trains a scene, and goes
where a plan sends it, in rounds. Frames of both are simulated, scenes of all trained alike, and measured on the same
frames at random poses of the reach, which none of them has seen. A seed moves the field along the spine, and draws
these frames.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from measuring import Document
from ultragray import GaussianScene, LinearProbe, plan_views
from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import about_axes
from ultragray.learn.evaluation.scoring import evaluate, render_sweep
from ultragray.learn.planning.settings import PlanSettings
from ultragray.learn.sweep import Dataset, Sweep
from ultragray.learn.training.config import TrainingConfig
from ultragray.learn.training.run import train
from ultragray.phantom import simulate
from ultragray.scene.confidence import supported

PROBE = LinearProbe(width_mm=38.0, near_mm=0.0, far_mm=50.0)
SIDE = 96  # pixels
HALF_MM, LENGTH_MM, TILT_DEG = 19.0, 48.0, 12.0  # of the field: its face's middle is at most so far aside
FRAMES = 48  # of a raster
ROUNDS = (6, 6, 6, 6)  # frames: the first are even, the others planned by the scene of those before
UNSEEN = 40
SEEDS = 10
TIMED_VIEWS = 50


def at(x: FloatArray, y: FloatArray, tilt_deg: FloatArray) -> FloatArray:  # [C] each -> [C, 4, 4]
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, :3, :3] = about_axes(np.tile([1.0, 0.0, 0.0], (len(x), 1)), np.radians(tilt_deg))
    poses[:, 0, 3], poses[:, 1, 3] = x, y
    return poses


def even(lanes: int, count: int, first_mm: float) -> FloatArray:
    """A raster of so many lanes over the field, `count` frames in all, upright."""
    aside = np.linspace(-HALF_MM, HALF_MM, lanes)
    along = first_mm + LENGTH_MM * (np.arange(count // lanes) + 0.5) / (count // lanes)
    x, y = (grid.ravel() for grid in np.meshgrid(aside, along, indexing="ij"))
    return at(x, y, np.zeros(len(x)))


def scan(poses: FloatArray) -> Sweep:
    images = simulate(poses, probe=PROBE, height=SIDE, width=SIDE)
    return Sweep(images, poses, PROBE, np.arange(len(poses)), "phantom")


def trained(poses: FloatArray, seed: int, *, confidence: bool = False) -> GaussianScene:
    sweep = scan(poses)
    config = TrainingConfig(seed=seed, refine_poses="none", confidence=confidence)
    return train(Dataset("planning", train=sweep, val=sweep.select([])), config)


def planned(seed: int, first_mm: float) -> FloatArray:
    """The frames of all rounds."""
    poses = even(2, ROUNDS[0], first_mm)
    box = f"{-HALF_MM}:{HALF_MM},{first_mm}:{first_mm + LENGTH_MM},-5:5"
    for count in ROUNDS[1:]:
        scene = trained(poses, seed, confidence=True)
        want = "confidence" if scene.info.confidence else "coverage"
        asked = PlanSettings(want=want, within_mm=2.0, views=count, box_mm=box, tilt_deg=TILT_DEG)
        poses = np.concatenate([poses, plan_views(scene, asked).poses])
    return poses


def measure(seed: int, _: Path) -> Document:
    random = np.random.default_rng(seed)
    first_mm = float(random.uniform(-36.0, 0.0))
    asides = random.uniform(-HALF_MM, HALF_MM, UNSEEN)
    unseen = scan(
        at(asides, random.uniform(first_mm, first_mm + LENGTH_MM, UNSEEN), random.uniform(-TILT_DEG, TILT_DEG, UNSEEN))
    )
    ways = {
        "overlapping": even(3, FRAMES, first_mm),
        "side by side": even(2, FRAMES, first_mm),
        "half of the latter": even(2, FRAMES // 2, first_mm),
        "planned": planned(seed, first_mm),
    }
    return {name: reached(trained(poses, seed), unseen) | {"frames": len(poses)} for name, poses in ways.items()}


def reached(scene: GaussianScene, unseen: Sweep) -> Document:
    mean = evaluate(scene, unseen).mean
    coverage = supported(render_sweep(scene, unseen, output="coverage")).mean()
    return {"psnr_db": mean.psnr_db, "ms_ssim": mean.ms_ssim, "coverage": float(coverage)}

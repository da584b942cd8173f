"""Half the frames, planned, against an even raster, on the phantom: `make planning`.

A robot may hold the probe anywhere over a field of the phantom's skin, tilted by up to 12° to either side. It scans an
even raster, its lanes overlapping by half or side by side; or it begins with a few frames, trains a scene, and goes
where a plan sends it, in rounds. Frames of both are simulated, scenes of all trained alike, and measured on the same
frames at random poses of the reach, which none of them has seen. A seed draws these frames, and is that of the
trainings. The time of a plan of 50 poses is that of the demo scene, the median of three.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from measuring import Document, Lines, columns, measure_runs
from ultragray import GaussianScene, LinearProbe, PlanSettings, plan_views
from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import about_axes
from ultragray.learn.evaluation.scoring import evaluate, render_sweep
from ultragray.learn.sweep import ByteArray, Dataset, Sweep
from ultragray.learn.training.config import TrainingConfig
from ultragray.learn.training.run import train
from ultragray.phantom import simulate
from ultragray.phantom.demo import load_demo_scene
from ultragray.scene.confidence import supported

PROBE = LinearProbe(width_mm=24.0, near_mm=0.0, far_mm=32.0)
SIDE = 64  # pixels
HALF_MM, FIRST_MM, LENGTH_MM, TILT_DEG = 12.0, -16.0, 32.0, 12.0  # of the field, for the middle of the face
FRAMES = 36  # of a raster
ROUNDS = (6, 12)  # frames: the first are even, the others planned by the scene of those before
WITHIN_MM = 2.0  # of coverage: about half the spacing of an even raster of half the frames
TRAINING = TrainingConfig(steps=100, max_gaussians=2500, refine_poses="none", confidence=False)
UNSEEN = 40
SEEDS = 10
TIMED_VIEWS = 50


def at(x: FloatArray, y: FloatArray, tilt_deg: FloatArray) -> FloatArray:  # [C] each -> [C, 4, 4]
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, :3, :3] = about_axes(np.tile([1.0, 0.0, 0.0], (len(x), 1)), np.radians(tilt_deg))
    poses[:, 0, 3], poses[:, 1, 3] = x, y
    return poses


def even(lanes: int, count: int) -> FloatArray:
    """A raster of so many lanes over the field, `count` frames in all, upright."""
    aside = np.linspace(-HALF_MM, HALF_MM, lanes)
    along = FIRST_MM + LENGTH_MM * (np.arange(count // lanes) + 0.5) / (count // lanes)
    x, y = (grid.ravel() for grid in np.meshgrid(aside, along, indexing="ij"))
    return at(x, y, np.zeros(len(x)))


def scan(poses: FloatArray) -> Sweep:
    """Frames in the order of their places along the spine: neighbours share scatterers."""
    ordered = poses[np.argsort(poses[:, 1, 3], kind="stable")]
    images = np.concatenate([frame(pose.tobytes()) for pose in ordered])
    return Sweep(images, ordered, PROBE, np.arange(len(poses)), "phantom")


@cache
def frame(pose: bytes) -> ByteArray:  # [4, 4] float64 -> [1, H, W]
    return simulate(np.frombuffer(pose).reshape(1, 4, 4), probe=PROBE, height=SIDE, width=SIDE)


def trained(sweep: Sweep, seed: int) -> GaussianScene:
    return train(Dataset("planning", train=sweep, val=sweep.select([])), replace(TRAINING, seed=seed))


def planned(seed: int) -> Sweep:
    """The frames of all rounds, the first of which are even."""
    poses = even(2, ROUNDS[0])
    box = f"{-HALF_MM}:{HALF_MM},{FIRST_MM}:{FIRST_MM + LENGTH_MM},-5:5"
    for count in ROUNDS[1:]:
        settings = PlanSettings(want="coverage", within_mm=WITHIN_MM, views=count, box_mm=box, tilt_deg=TILT_DEG)
        poses = np.concatenate([poses, plan_views(trained(scan(poses), seed), settings).poses])
    return scan(poses)


def measure(seed: int, _: Path) -> Document:
    random = np.random.default_rng(seed)
    low, high = (-HALF_MM, FIRST_MM, -TILT_DEG), (HALF_MM, FIRST_MM + LENGTH_MM, TILT_DEG)
    unseen = scan(at(*random.uniform(low, high, (UNSEEN, 3)).T))
    ways = {
        "overlapping": scan(even(3, FRAMES)),
        "side by side": scan(even(2, FRAMES)),
        "half": scan(even(2, FRAMES // 2)),
        "planned": planned(seed),
    }
    return {name: {"frames": len(sweep), **reached(trained(sweep, seed), unseen)} for name, sweep in ways.items()}


def reached(scene: GaussianScene, unseen: Sweep) -> Document:
    mean = evaluate(scene, unseen).mean
    coverage = supported(render_sweep(scene, unseen, output="coverage")).mean()
    return {"psnr_db": mean.psnr_db, "ms_ssim": mean.ms_ssim, "coverage": float(coverage)}


def timed(_: Path) -> Document:
    """Seconds of a plan on the demo scene, by the wall and of the processor."""
    scene, took = load_demo_scene(), []
    for _ in range(4):
        began = time.perf_counter(), time.process_time()
        plan = plan_views(scene, PlanSettings(views=TIMED_VIEWS, within_mm=0.3))
        took.append((time.perf_counter() - began[0], time.process_time() - began[1]))
    wall_s, processor_s = np.median(took[1:], axis=0).tolist()  # the first prepares the scene
    return {"views": len(plan.poses), "seconds": wall_s, "processor_seconds": processor_s}


def planned_and_even(runs: Document) -> Lines:
    """What each way of scanning reached, and how often the planned one did as well as an even raster."""
    seeds = [run for name, run in runs.items() if name.startswith("seed")]
    names = {"overlapping": "even, lanes overlapping by half", "side by side": "even, lanes side by side"}
    names |= {"half": "even, lanes side by side", "planned": "planned"}
    rows = []
    for way, words in names.items() if seeds else ():
        figures = {key: np.array([run[way][key] for run in seeds]) for key in ("psnr_db", "ms_ssim", "coverage")}
        own = np.array([run["planned"]["psnr_db"] for run in seeds])
        rows.append(
            {
                "way": words,
                "frames": seeds[0][way]["frames"],
                **{key: f"{values.mean():.3f} ± {values.std():.3f}" for key, values in figures.items()},
                "psnr_db": f"{figures['psnr_db'].mean():.2f} ± {figures['psnr_db'].std():.2f}",
                "reached": "" if way == "planned" else f"{(own >= figures['psnr_db']).sum()} of {len(seeds)}",
            }
        )
    titles = {"Raster": "{way}", "Frames": "{frames}", "PSNR, dB": "{psnr_db}", "MS-SSIM": "{ms_ssim}"}
    yield from columns(rows, {**titles, "Coverage": "{coverage}", "PSNR reached by the plan": "{reached}"})
    if "time" in runs:
        yield ""
        yield (
            "A plan of {views} views on the demo scene: {seconds:.1f} s, {processor_seconds:.1f} s of one processor."
        ).format_map(runs["time"])


RUNS = {"time": timed, **{f"seed {seed}": partial(measure, seed) for seed in range(SEEDS)}}

if __name__ == "__main__":
    measure_runs("planning", __doc__, RUNS, threads=1, at_once=2)

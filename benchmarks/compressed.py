"""What compressed scene files keep: bytes, and frames against those of the scenes as they were: `make compressed`.

Of the built-in phantom the demo scene is used, and frames beside its sweep are simulated; the other sets are trained by
STEPS steps, without their held-out frames; a scene that lies in build/bench/compressed is taken as it is. Frames are
those of training and held-out poses. Where only the first parts of a file have arrived, frames are those that
libultragray makes of them.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from measuring import STAGE, Document, Lines, columns, measure_runs, teller
from ultragray import render
from ultragray.datasets.source import load_dataset
from ultragray.learn.sweep import Sweep
from ultragray.learn.training import TrainingConfig, train
from ultragray.phantom import PHANTOM_IMAGE_SIDE, PHANTOM_PROBE, freehand_poses, simulate
from ultragray.phantom.demo import load_demo_scene
from ultragray.scene.compressed import pack
from ultragray.scene.gaussians import GaussianScene

PHANTOM = "phantom"
SETS = (PHANTOM, "spine_phantom", "liver_convex", "ultranerf_liver")
STEPS, MAX_GAUSSIANS = 400, 60_000
MOST_FRAMES = 24  # of a sweep, evenly taken
SIMULATED = 6  # of the phantom, whose frames take seconds
PERCENTILE = 99.9
THREADS = 1


def measure(name: str, data_folder: Path) -> Document:
    scene, sweeps = trained(name, data_folder)
    path = STAGE / "compressed" / f"{name}.ugz"
    path.parent.mkdir(parents=True, exist_ok=True)
    scene.save(path)
    parts = pack({key: tensor.numpy() for key, tensor in scene.splats.items()}, labels_of(scene))
    level = {**{key: tensor.numpy() for key, tensor in scene.splats.items()}, "shN": scene.shN[:, :0].numpy()}
    degree_0 = sum(map(len, pack(level, labels_of(scene))))
    frames = [drawn(scene, sweep) for sweep in sweeps]
    compressed = [drawn(GaussianScene.load(path), sweep) for sweep in sweeps]
    truths = [sweep.images.astype(np.float32) / 255.0 for sweep in sweeps]
    apart = [np.abs(one - other) for one, other in zip(frames, compressed, strict=True)]
    changes = [
        float(np.mean(psnr_db(other, true) - psnr_db(one, true)))
        for one, other, true in zip(frames, compressed, truths, strict=True)
    ]
    counts = np.cumsum([int.from_bytes(part[:4], "little") for part in parts])
    ends = np.cumsum([len(part) for part in parts])
    return {
        "gaussians": scene.gaussian_count,
        "sh_degree": scene.sh_degree,
        "frames": sum(map(len, frames)),
        "bytes_per_gaussian": float(ends[-1] / scene.gaussian_count),
        "bytes_per_gaussian_of_degree_0": degree_0 / scene.gaussian_count,
        "share_of_file": path.stat().st_size / len(scene.to_bytes()),
        "psnr_change_db": {"training": changes[0], "held_out": changes[1]},
        "percentile_of_change": float(np.percentile(np.concatenate([one.ravel() for one in apart]), PERCENTILE)),
        "worst_frame": max(float(np.percentile(frame, PERCENTILE)) for one in apart for frame in one),
        "beginnings": [
            {"share": float(end / ends[-1]), "psnr_db": beginning(path, int(count), sweeps[1], frames[1])}
            for end, count in zip(ends[:-1], counts[:-1], strict=True)
        ],
    }


def trained(name: str, data_folder: Path) -> tuple[GaussianScene, tuple[Sweep, Sweep]]:
    """A scene, and frames that it was trained from, and that it was not."""
    if name == PHANTOM:
        scene = load_demo_scene()
        poses = freehand_poses(SIMULATED, tilt_deg=5.0, offset_mm=1.0, unrest=3.0)
        return scene, (simulated(spread(scene.training_poses, SIMULATED)), simulated(poses))
    dataset = load_dataset(data_folder / name)
    path = STAGE / "compressed" / f"{name}.ugr"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        config = TrainingConfig.preset("fast", steps=STEPS, max_gaussians=MAX_GAUSSIANS, confidence=False)
        train(dataset, config, report=teller(name)).save(path)
    places = [spread(np.arange(len(sweep))) for sweep in (dataset.train, dataset.val)]
    return GaussianScene.load(path), (dataset.train.select(places[0]), dataset.val.select(places[1]))


def simulated(poses: np.ndarray) -> Sweep:  # [F, 4, 4]
    images = simulate(poses, probe=PHANTOM_PROBE, height=PHANTOM_IMAGE_SIDE, width=PHANTOM_IMAGE_SIDE)
    return Sweep(images, poses, PHANTOM_PROBE, np.arange(len(poses)), PHANTOM)


def spread(values: np.ndarray, most: int = MOST_FRAMES) -> np.ndarray:
    chosen: np.ndarray = values[np.unique(np.linspace(0, len(values) - 1, most).round().astype(int))]
    return chosen


def labels_of(scene: GaussianScene) -> np.ndarray | None:
    return None if scene.labels is None else scene.labels.numpy()


def drawn(scene: GaussianScene, sweep: Sweep) -> np.ndarray:  # [F, H, W]
    size = {"height": sweep.height, "width": sweep.width, "outputs": ("bmode",)}
    with torch.no_grad():
        return np.concatenate([render(scene, sweep.probe, pose, **size)["bmode"].numpy() for pose in sweep.poses])


def beginning(path: Path, count: int, sweep: Sweep, whole: np.ndarray) -> float:  # [F, H, W]
    """How near frames of the first Gaussians of a file, enlarged as libultragray does, come to those of all, in dB."""
    scene = GaussianScene.load(path)
    splats = {key: tensor[:count] for key, tensor in scene.splats.items()}
    splats["scales"] = splats["scales"] + math.log(scene.gaussian_count / count) / 8.0
    first = GaussianScene.from_splats(
        splats,
        info=replace(scene.info, label_names={}),
        training_poses=scene.training_poses,
        pose_corrections=scene.pose_corrections,
        rest_poses=scene.rest_poses,
    )
    return float(np.mean(psnr_db(drawn(first, sweep), whole)))


def psnr_db(frames: np.ndarray, truth: np.ndarray) -> np.ndarray:  # [F, H, W] both -> [F]
    squares: np.ndarray = np.square(frames.astype(np.float64) - truth).mean(axis=(1, 2))
    return -10.0 * np.log10(squares)


def kept(measured: Document) -> Lines:
    """The table of the documents."""
    rows = [
        {
            **run,
            "name": name,
            "training": run["psnr_change_db"]["training"],
            "held_out": run["psnr_change_db"]["held_out"],
            "first": ", ".join(f"{one['share']:.0%}: {one['psnr_db']:.1f}" for one in run["beginnings"]),
        }
        for name, run in measured.items()
    ]
    cells = {
        "Scene": "{name}",
        "Gaussians": "{gaussians:,}",
        "Bytes of each, of degree 0": "{bytes_per_gaussian_of_degree_0:.1f}",
        "and with all harmonics": "{bytes_per_gaussian:.1f}",
        "Of the file": "{share_of_file:.0%}",
        "PSNR of training, held-out frames, dB": "{training:+.3f}, {held_out:+.3f}",
        "99.9 of 100 pixels change by at most": "{percentile_of_change:.4f}",
        "in the worst frame": "{worst_frame:.4f}",
        "dB to the whole, after a share of the bytes": "{first}",
    }
    return columns(rows, cells)


if __name__ == "__main__":
    measure_runs("compressed", __doc__, {name: partial(measure, name) for name in SETS}, threads=THREADS)

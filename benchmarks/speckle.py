"""Rendered frames with natural speckle beside true ones that were held out, and what it costs: `make speckle`.

Each set is trained by STEPS steps, without its held-out frames; a scene that lies in build/bench/speckle is taken as it
is. Measured are the texture of the held-out frames, how windows at one place in space decorrelate from frame to frame,
and how well a small classifier of windows, trained on the first half of these frames, tells rendered from true on the
second.
"""

from __future__ import annotations

import math
import statistics
import time
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from measuring import STAGE, Document, Lines, columns, measure_runs, teller
from ultragray.datasets.source import load_dataset
from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import rotations_of
from ultragray.learn.evaluation.scoring import evaluate
from ultragray.learn.evaluation.speckle import (
    FrameArray,
    SpeckleSummary,
    WindowPairs,
    calmest,
    compare_speckle,
    correlation,
    summarize,
    tiles_of,
)
from ultragray.learn.sweep import Dataset, IntArray, Sweep, spread_places
from ultragray.learn.training import TrainingConfig, train
from ultragray.learn.training.speckle import fit_speckle, frame_pairs
from ultragray.phantom import load_phantom, simulate
from ultragray.phantom.demo import demo_poses, load_demo_scene
from ultragray.rendering.frames import render
from ultragray.rendering.settings import Speckle
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.speckle import BANDS, LEVELS, SpeckleModel

PHANTOM = "phantom"
SETS = (PHANTOM, "ultranerf_liver", "spine_phantom", "liver_convex")
STEPS, MAX_GAUSSIANS = 500, 80_000
MOST_FRAMES = 48
GREYS = 32  # of the histograms
ELEVATION_MM = (0.0, 0.2, 0.4, 0.7, 1.0, 1.5, 2.5, 4.0)
ANGLE_DEG = (0.0, 0.4, 0.8, 1.5, 3.0, 6.0, 12.0)
BASES, SHIFTS_MM, TILTS_DEG = 5, (0.1, 0.3, 0.5, 0.8, 1.2, 2.0), (0.5, 1.0, 2.0, 4.0)
UPRIGHT_DEG = 1.0
LEAST_PAIRS = 100
BATCHES, BATCH = 500, 128
SIDE = 512
ROUNDS = 60


def measure(name: str, data_folder: Path) -> Document:
    """A set: texture, decorrelation and the classifier's success, today and with natural speckle."""
    dataset = load_phantom() if name == PHANTOM else load_dataset(data_folder / name)
    scene = trained(name, dataset)
    began = time.perf_counter()
    scene.info = replace(scene.info, speckle=fit_speckle(scene, dataset.train, backend="auto"))
    fit_s = time.perf_counter() - began
    held_out = dataset.val.select(spread_places(len(dataset.val), MOST_FRAMES))
    true = held_out.images.astype(np.float32) / 255.0
    by_kind = {one.value: drawn(scene, held_out, one) for one in Speckle}
    model = scene.info.speckle
    assert model is not None
    return {
        "frames": len(held_out),
        "fit_s": fit_s,
        "model": model.__dict__ | {"strength": list(model.strength)},
        "psnr_db": evaluate(scene, held_out).mean.psnr_db,  # without speckle
        "texture": {value: texture(frames, true, held_out) for value, frames in by_kind.items()},
        "decorrelation": decorrelation(scene, *pairs_of_frames(name, dataset)),
        "area_under_curve": {value: area_under_curve(frames, true) for value, frames in by_kind.items()},
    }


def trained(name: str, dataset: Dataset) -> GaussianScene:
    path = STAGE / "speckle" / f"{name}.ugr"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        config = TrainingConfig.preset("fast", steps=STEPS, max_gaussians=MAX_GAUSSIANS, confidence=False)
        train(dataset, config, report=teller(name)).save(path)
    return GaussianScene.load(path)


def drawn(scene: GaussianScene, sweep: Sweep, speckle: Speckle) -> FrameArray:  # [F, H, W]
    options = {"height": sweep.height, "width": sweep.width, "outputs": ("bmode",), "speckle": speckle}
    with torch.no_grad():
        frames = [render(scene, sweep.probe, pose, **options)["bmode"] for pose in sweep.poses]
    return np.asarray(torch.cat(frames).mul(255.0).round().div(255.0).numpy())  # in 8 bits, as true frames are


def texture(frames: FrameArray, true: FrameArray, sweep: Sweep) -> Document:
    """How far statistics are from those of the true frames, as shares of these."""
    summary: SpeckleSummary = summarize(compare_speckle(frames, true, sweep.probe))
    assert summary.true is not None
    assert summary.rendered is not None
    own, wanted = summary.rendered.__dict__, summary.true.__dict__
    counts = [np.histogram(one, GREYS, (0.0, 1.0))[0] / one.size for one in (frames, true)]
    return {
        **{name: own[name] / wanted[name] - 1.0 for name in wanted},
        "histogram": 0.5 * float(np.abs(counts[0] - counts[1]).sum()),  # share of the pixels in another bin
        "true": wanted,
    }


def pairs_of_frames(name: str, dataset: Dataset) -> tuple[Sweep, IntArray]:
    """Frames that lie close together, [P, 2] of them at a time: of the phantom simulated, about held-out poses; else of
    a recording, one of each pair held out."""
    if name == PHANTOM:
        poses = np.concatenate([about(pose) for pose in dataset.val.poses[:: len(dataset.val) // BASES][:BASES]])
        images = simulate(poses, probe=dataset.probe, height=dataset.val.height, width=dataset.val.width)
        count = len(poses) // BASES
        pairs = [(base, base + other) for base in range(0, len(poses), count) for other in range(1, count)]
        return Sweep(images, poses, dataset.probe, np.arange(len(poses)), name), np.array(pairs)
    both = Sweep(
        np.concatenate([dataset.val.images, dataset.train.images]),
        np.concatenate([dataset.val.poses, dataset.train.poses]),
        dataset.probe,
        np.arange(len(dataset.val) + len(dataset.train)),
        name,
    )
    pairs = frame_pairs(both)
    pairs = pairs[(pairs < len(dataset.val)).any(axis=1)]
    frames = np.unique(pairs)
    return both.select(frames), np.searchsorted(frames, pairs)


def about(pose: FloatArray) -> FloatArray:  # [4, 4] mm -> [K, 4, 4]
    """A pose, the same shifted along elevation, and tilted about the lateral axis in the middle of the image."""
    moved = [np.eye(4)]
    for shift_mm in SHIFTS_MM:
        moved.append(np.eye(4))
        moved[-1][1, 3] = shift_mm
    middle = np.array([0.0, 0.0, 30.0])
    for tilt_deg in TILTS_DEG:
        moved.append(np.eye(4))
        moved[-1][:3, :3] = rotations_of(np.array([[math.radians(tilt_deg), 0.0, 0.0]]))[0]
        moved[-1][:3, 3] = middle - moved[-1][:3, :3] @ middle
    return pose @ np.stack(moved)


def decorrelation(scene: GaussianScene, part: Sweep, pairs: IntArray) -> Document:
    """Correlations of pairs of windows by their distance and their angle, of true and of rendered frames."""
    true = part.images.astype(np.float32) / 255.0
    windows = WindowPairs.between(true, part.poses, part.probe, pairs)
    by_kind = {"true": true, **{one.value: drawn(scene, part, one) for one in Speckle}}
    moments = {name: windows.moments(one) for name, one in by_kind.items()}
    upright = windows.angle_deg < UPRIGHT_DEG
    near = windows.elevation_mm < ELEVATION_MM[2]
    return {
        "elevation_mm": by_bins(windows.elevation_mm, ELEVATION_MM, moments, upright),
        "angle_deg": by_bins(windows.angle_deg, ANGLE_DEG, moments, near),
    }


def by_bins(values: FloatArray, edges: tuple[float, ...], moments: dict[str, FloatArray], among: Any) -> list[Document]:
    rows = []
    for low, high in pairwise(edges):
        chosen = among & (values >= low) & (values < high)
        if chosen.sum() >= LEAST_PAIRS:
            correlations = {name: correlation(own[chosen]) for name, own in moments.items()}
            about = {"from": low, "to": high, "windows": int(chosen.sum())}
            rows.append(about | correlations)
    return rows


def area_under_curve(frames: FrameArray, true: FrameArray) -> float:
    """Of a small network that tells rendered windows from true ones; it is trained on the first half of the frames.

    It sees windows without their means, for it is to tell texture.
    """
    torch.manual_seed(0)
    (grey, labels), (unseen, truth) = (labelled(frames[half], true[half]) for half in halves(len(true)))
    scale = grey.std()
    network = nn.Sequential(
        nn.Conv2d(1, 16, 3), nn.ReLU(), nn.Conv2d(16, 32, 3, stride=2), nn.ReLU(),
        nn.Conv2d(32, 32, 3), nn.ReLU(), nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(32, 1),
    )  # fmt: skip
    optimizer = torch.optim.Adam(network.parameters(), 3e-3)
    for _ in range(BATCHES):
        batch = torch.randint(len(grey), (BATCH,))
        optimizer.zero_grad()
        scores = network(flipped(grey[batch]) / scale)[:, 0]
        nn.functional.binary_cross_entropy_with_logits(scores, labels[batch]).backward()
        optimizer.step()
    with torch.no_grad():
        predictions = network(unseen / scale)[:, 0].numpy()
    order = predictions.argsort(kind="stable").argsort(kind="stable") + 1
    positive = truth.numpy() > 0.5
    count = int(positive.sum())
    return float((order[positive].sum() - count * (count + 1) / 2) / (count * (len(order) - count)))


def halves(count: int) -> tuple[slice, slice]:
    return slice(0, count // 2), slice(count // 2, count)


def labelled(frames: FrameArray, true: FrameArray) -> tuple[Tensor, Tensor]:  # [N, 1, n, n], [N]
    """Windows of rendered frames, 1, and of true ones at the same places, 0."""
    places = [calmest(tiles_of(one), 1.0) for one in true]
    windows = [
        np.concatenate([tiles_of(one)[place] for one, place in zip(kind, places, strict=True)])
        for kind in (frames, true)
    ]
    grey = torch.from_numpy(np.concatenate(windows).astype(np.float32))[:, None]
    labels = torch.cat([torch.ones(len(windows[0])), torch.zeros(len(windows[1]))])
    return grey - grey.mean(dim=(2, 3), keepdim=True), labels


def flipped(windows: Tensor) -> Tensor:
    return windows.flip(-1) if torch.rand(()) < 0.5 else windows


def cost(_: Path) -> Document:
    """Processor time, in ms, of a frame of 512x512 of the demo scene without speckle and with it, in turn."""
    scene, poses = load_demo_scene(), demo_poses(ROUNDS)
    probe = scene.info.probe_or(None)
    pixel = probe.scan_line_length_mm / SIDE
    sizes = {"as of the phantom": (0.18, 0.36), "as fine as pixels": (0.9 * pixel, 1.5 * pixel)}
    by_size = {}
    for name, (axial, lateral) in sizes.items():
        model = SpeckleModel(
            seed=0,
            axial_mm=(axial,) * BANDS,
            lateral_mm=(lateral,) * BANDS,
            elevation_mm=(0.7,) * BANDS,
            cell_mm=(2.0 * lateral, 0.95, 2.0 * axial),
            strength=(0.06,) * LEVELS,
            wavenumber_per_mm=40.0,
            looks=2.0,
        )
        scene.info = replace(scene.info, speckle=model)
        took: dict[Speckle, list[float]] = {one: [] for one in Speckle}
        for pose in poses:
            for one in Speckle:
                began = time.thread_time()
                render(scene, None, pose, height=SIDE, width=SIDE, outputs=("bmode",), speckle=one)
                took[one].append(1e3 * (time.thread_time() - began))
        differences = [on - off for off, on in zip(*took.values(), strict=True)]
        by_size[name] = {
            "frame_ms": statistics.median(took[Speckle.OFF]),
            "with_ms": statistics.median(took[Speckle.NATURAL]),
            "added_ms": statistics.median(differences),
            "least_frame_ms": min(took[Speckle.OFF]),
            "least_with_ms": min(took[Speckle.NATURAL]),
        }
    return by_size


def textures(figures: Document) -> Lines:
    """Held-out frames without and with speckle."""
    rows = [
        {
            "name": name,
            "speckle": value,
            **figures[name]["texture"][value],
            "auc": figures[name]["area_under_curve"][value],
        }
        for name in SETS
        if name in figures
        for value in ("off", "natural")
    ]
    return columns(
        rows,
        {
            "set": "{name}",
            "speckle": "{speckle}",
            "contrast": "{contrast:+.0%}",
            "axial width": "{axial_mm:+.0%}",
            "lateral width": "{lateral_mm:+.0%}",
            "axial gradient": "{axial_gradient:+.0%}",
            "lateral gradient": "{lateral_gradient:+.0%}",
            "pixels in another bin of grey": "{histogram:.1%}",
            "told from true: area under the curve": "{auc:.2f}",
        },
    )


def decorrelations(figures: Document) -> Lines:
    """Correlations of windows at one place in space, by what lies between the frames."""
    rows = [
        {"name": name, "what": f"{row['from']:g} to {row['to']:g} {unit}", **row}
        for name in SETS
        if name in figures
        for measure, unit in (("elevation_mm", "mm"), ("angle_deg", "°"))
        for row in figures[name]["decorrelation"][measure]
    ]
    return columns(
        rows,
        {
            "set": "{name}",
            "frames apart by": "{what}",
            "windows": "{windows}",
            "true": "{true:.2f}",
            "off": "{off:.2f}",
            "natural": "{natural:.2f}",
        },
    )


def costs(figures: Document) -> Lines:
    """What speckle adds to a frame."""
    rows = [{"name": name, **one} for name, one in figures.get("cost", {}).items() if name != "measured"]
    return columns(
        rows,
        {"speckle": "{name}", "frame": "{frame_ms:.2f} ms", "added, median of pairs": "{added_ms:.2f} ms"},
    )


if __name__ == "__main__":
    runs = {name: partial(measure, name) for name in SETS}
    measure_runs("speckle", __doc__, {"cost": cost, **runs}, threads=1)

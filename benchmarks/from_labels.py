"""Scenes from labels against theory and against the phantoms' own simulations: `make from-labels`.

Theory: the slope of the grey level in a block of one tissue against attenuation, at five tissues and two frequencies,
and the statistics of its speckle against those of fully developed scattering. Phantom: the spine made from its labels
against its simulation, at poses of the held-out sweep: the grey level of each tissue, and the errors of frames.

Detector: a small network that tells the pixels of vessels and gallbladder, trained on frames of the made abdomen alone,
once as made and once refined by a few simulated frames, and tested on other simulated frames, between which and those
no scene was made.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from measuring import Document, Lines, columns, measure_runs
from ultragray import GaussianScene, LinearProbe, render
from ultragray.learn.sweep import Dataset, Sweep
from ultragray.learn.synthesis.scene import scene_from_labels
from ultragray.learn.training import TrainingConfig, train
from ultragray.phantom.abdomen import ABDOMEN, ABDOMEN_PROBE, NAMES
from ultragray.phantom.anatomy import SPINE, Phantom, Tissue
from ultragray.phantom.imaging import simulate, tissues
from ultragray.phantom.recipes import abdomen_recipe, spine_recipe
from ultragray.phantom.sweeps import PHANTOM_PROBE, freehand_poses
from ultragray.rendering.frames import render_shown
from ultragray.rendering.settings import Encoding, FrameSettings
from ultragray.scene.recipes import SceneRecipe, TissueBody
from ultragray.scene.shapes import BoxShape

BLOCK = BoxShape(min_mm=(-20.0, -15.0, 0.0), max_mm=(20.0, 15.0, 45.0))
SLOPES = [("liver", 0.9), ("liver", 0.8), ("liver", 0.7), ("liver", 0.34), ("liver", 0.2)]  # dB/(cm MHz)
FREQUENCIES_MHZ = (3.5, 5.0)
COMPENSATED = 0.54
SPINE_FRAMES, SIDE = 3, 128
TARGETS = [NAMES.index(name) + 1 for name in ("blood", "cyst")]
TEST_Y_MM, REFINE_Y_MM = np.arange(-14.0, 15.0, 4.0), np.arange(-12.0, 15.0, 4.0)
MADE_FRAMES, GAUSSIANS = 120, 60_000
STEPS, BATCH, REFINE_STEPS = 500, 8, 120
SEEDS = 3  # of the detector: its Dice differs by .3 between them
THREADS = 1


def block(attenuation: float, frequency_mhz: float) -> GaussianScene:
    probe = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)
    body = TissueBody(tissue="liver", shape=BLOCK, attenuation=attenuation)
    view = {"towards": (0.0, 0.0, 1.0), "along": (0.0, 1.0, 0.0), "probe": probe, "sweep_mm": 16.0, "pose_count": 17}
    return scene_from_labels(
        SceneRecipe(bodies=(body,), level=0.55, frequency_mhz=frequency_mhz, gaussian_count=10_000, **view)
    )


def theory(_: Path) -> Document:
    slopes: list[Document] = []
    for _, attenuation in SLOPES:
        for frequency in FREQUENCIES_MHZ:
            scene = block(attenuation, frequency)
            probe = scene.info.probe_or(None)
            frames = render(scene, None, scene.training_poses[::4], height=160, width=96, outputs=("bmode",))["bmode"]
            depths, level = probe.depths_mm(160), frames[:, :, 24:72].mean(dim=(0, 2)).numpy()
            inner = (depths > 4.0) & (depths < 32.0)
            slope = 600.0 * float(np.polyfit(depths[inner], level[inner], 1)[0])  # dB/cm
            expected = -2.0 * frequency * (attenuation - COMPENSATED)
            slopes.append({"attenuation": attenuation, "mhz": frequency, "db_per_cm": slope, "expected": expected})
    scene = block(COMPENSATED, 5.0)
    settings = FrameSettings(height=320, width=240, speckle="natural").resolved(scene.info, Encoding.FLOAT32)
    level_db = 60.0 * render_shown(scene, settings, scene.training_poses[::2])["bmode"].numpy()[:, 40:280, 20:220]
    amplitude = 10.0 ** (level_db / 20.0)
    return {
        "slopes": [{name: round(value, 4) for name, value in one.items()} for one in slopes],
        "speckle_snr": float(amplitude.mean() / amplitude.std()),
        "speckle_db": float(level_db.std()),
    }


def spine(_: Path) -> Document:
    recipe, space = spine_recipe()
    poses = freehand_poses(9, tilt_deg=5.0, offset_mm=1.0, unrest=3.0)[3 : 3 + SPINE_FRAMES]
    scene = scene_from_labels(recipe, space=space, poses=freehand_poses(91))
    bmode = drawn(scene, poses, speckle=False)
    truth = simulated(SPINE, PHANTOM_PROBE, poses)
    labels = tissues(poses, probe=PHANTOM_PROBE, height=SIDE, width=SIDE)
    smooth = functional.avg_pool2d(torch.from_numpy(np.stack([bmode, truth])), 5, 1, 2).numpy()
    means = {
        tissue.name.lower(): [round(float(one[labels == tissue].mean()), 4) for one in (bmode, truth)]
        for tissue in Tissue
        if (labels == tissue).sum() > 200
    }
    return {
        "grey_levels": means,
        "psnr_db": psnr(bmode, truth),
        "smooth_psnr_db": psnr(smooth[0], smooth[1]),
        "smooth_correlation": float(np.corrcoef(smooth[0].ravel(), smooth[1].ravel())[0, 1]),
    }


def drawn(scene: GaussianScene, poses: np.ndarray, *, speckle: bool) -> np.ndarray:  # [C, SIDE, SIDE]
    settings = FrameSettings(height=SIDE, width=SIDE, speckle="natural" if speckle else "off")
    return render_shown(scene, settings.resolved(scene.info, Encoding.FLOAT32), poses)["bmode"].numpy()


def simulated(phantom: Phantom, probe: LinearProbe, poses: np.ndarray) -> np.ndarray:  # [C, SIDE, SIDE]
    return (simulate(poses, probe=probe, height=SIDE, width=SIDE, phantom=phantom) / 255.0).astype(np.float32)


def psnr(frames: np.ndarray, truth: np.ndarray) -> float:
    return float(-10.0 * np.log10(np.square(frames - truth).mean()))


def detector(_: Path) -> Document:
    """Vessels and gallbladder in simulated frames of the abdomen that no training saw."""
    test_poses, refine_poses = (at(y_mm) for y_mm in (TEST_Y_MM, REFINE_Y_MM))
    every = np.concatenate([test_poses, refine_poses])
    frames = simulated(ABDOMEN, ABDOMEN_PROBE, every)
    test, refine = frames[: len(test_poses)], frames[len(test_poses) :]
    targets = np.isin(tissues(test_poses, probe=ABDOMEN_PROBE, height=SIDE, width=SIDE, phantom=ABDOMEN), TARGETS)
    recipe, space = abdomen_recipe(gaussian_count=GAUSSIANS)
    start = scene_from_labels(recipe, space=space)
    sweep = Sweep(np.round(255.0 * refine).astype(np.uint8), refine_poses, ABDOMEN_PROBE, np.arange(len(refine)), "few")
    none = sweep.select(np.zeros(0, int))
    config = TrainingConfig(steps=REFINE_STEPS, confidence=False, refine_poses="none", batch_size=4)
    refined = train(Dataset("few", train=sweep, val=none), config, start=start)
    figures: Document = {"test_frames": len(test), "refining_frames": len(refine), "pixels": int(targets.sum())}
    random = np.random.default_rng(0)
    poses = varied(random, MADE_FRAMES)
    masks = np.isin(tissues(poses, probe=ABDOMEN_PROBE, height=SIDE, width=SIDE, phantom=ABDOMEN), TARGETS)
    for name, scene in (("made", start), ("refined", refined)):
        images = drawn(scene, poses, speckle=True)
        scores = [scored(trained(images, masks, seed), test, targets) for seed in range(SEEDS)]
        figures[name] = {
            **{key: float(np.mean([score[key] for score in scores])) for key in scores[0]},
            "dices": [score["dice"] for score in scores],
            "psnr_db": psnr(drawn(scene, test_poses, speckle=False), test),
        }
    return figures


def scored(network: nn.Module, frames: np.ndarray, targets: np.ndarray) -> dict[str, float]:
    with torch.no_grad():
        mask = network(as_input(frames)).numpy()[:, 0] > 0.0
    both = float((mask & targets).sum())
    return {
        "dice": 2.0 * both / max(1, mask.sum() + targets.sum()),
        "precision": both / max(1, mask.sum()),
        "recall": both / targets.sum(),
    }


def at(y_mm: np.ndarray) -> np.ndarray:  # [C] -> [C, 4, 4]
    poses = np.tile(np.eye(4), (len(y_mm), 1, 1))
    poses[:, 1, 3] = y_mm
    return poses


def varied(random: np.random.Generator, count: int) -> np.ndarray:  # [C, 4, 4]
    """Poses beside those of the sweep, a little to the side and turned."""
    poses = freehand_poses(count, unrest=float(random.uniform(0.0, 6.0)))
    poses[:, 0, 3] += random.uniform(-4.0, 4.0, count)
    poses[:, 1, 3] *= 0.6
    return poses


def as_input(frames: np.ndarray) -> Tensor:  # [C, H, W] -> [C, 1, H, W]
    return torch.from_numpy(np.asarray(frames, np.float32))[:, None]


def trained(images: np.ndarray, masks: np.ndarray, seed: int) -> nn.Module:
    torch.manual_seed(seed)
    network, random = Detector(), np.random.default_rng(seed)
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    weight = torch.tensor(min(20.0, float((~masks).sum() / max(1, masks.sum()))) ** 0.5)
    for _ in range(STEPS):
        chosen = random.choice(len(images), BATCH, replace=False)
        gains = random.uniform(0.8, 1.25, (BATCH, 1, 1)).astype(np.float32)
        batch, truth = as_input(images[chosen] * gains), torch.from_numpy(masks[chosen]).float()[:, None]
        loss = functional.binary_cross_entropy_with_logits(network(batch), truth, pos_weight=weight)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return network.eval()


class Detector(nn.Module):
    """A network of two scales: what a pixel shows, and what is around it."""

    def __init__(self) -> None:
        super().__init__()
        self.fine = nn.Sequential(nn.Conv2d(1, 8, 5, padding=2), nn.ReLU(), nn.Conv2d(8, 8, 3, padding=1), nn.ReLU())
        self.coarse = nn.Sequential(
            nn.AvgPool2d(4), nn.Conv2d(8, 16, 5, padding=2), nn.ReLU(), nn.Conv2d(16, 16, 5, padding=2), nn.ReLU()
        )
        self.last = nn.Conv2d(24, 1, 3, padding=1)

    def forward(self, frames: Tensor) -> Tensor:  # [C, 1, H, W]
        fine = self.fine(frames)
        coarse = functional.interpolate(self.coarse(fine), scale_factor=4, mode="bilinear")
        return self.last(torch.cat([fine, coarse], dim=1))


def lines(measured: Document) -> Lines:
    """The table of the documents, of what is measured."""
    of_theory, of_spine, of_detector = (measured.get(name) for name in RUNS)
    rows = []
    if of_theory is not None:
        errors = [abs(one["db_per_cm"] / one["expected"] - 1.0) for one in of_theory["slopes"]]
        snr = math.sqrt(math.pi / (4.0 - math.pi))
        rows += [
            ("Slopes of attenuation; largest error", f"{len(errors)}; {max(errors):.1%}"),
            (f"Speckle: mean over deviation of the amplitude (theory {snr:.2f})", f"{of_theory['speckle_snr']:.2f}"),
            ("deviation of its logarithm, dB (theory 5.57)", f"{of_theory['speckle_db']:.2f}"),
        ]
    if of_spine is not None:
        levels = [abs(own - truth) for own, truth in of_spine["grey_levels"].values()]
        smooth = f"{of_spine['smooth_psnr_db']:.1f}; {of_spine['smooth_correlation']:.2f}"
        rows += [
            ("Spine, made and simulated: difference of a tissue's grey, mean", f"{np.mean(levels):.3f}"),
            ("the largest", f"{max(levels):.3f}"),
            ("PSNR of frames against the simulation, dB", f"{of_spine['psnr_db']:.1f}"),
            ("both smoothed over five pixels, dB; correlation", smooth),
        ]
    if of_detector is not None:
        refining = of_detector["refining_frames"]
        for name, words in (("made", "the made scene alone"), ("refined", f"the scene refined by {refining} frames")):
            one = of_detector[name]
            what = f"Detector trained on {words}: Dice (of {len(one['dices'])} trainings); precision; recall"
            dice = f"{one['dice']:.2f} ({min(one['dices']):.2f} to {max(one['dices']):.2f})"
            rows.append((what, f"{dice}; {one['precision']:.2f}; {one['recall']:.2f}"))
    return columns([{"what": what, "found": value} for what, value in rows], {"Measured": "{what}", "": "{found}"})


RUNS = {"theory": theory, "spine": spine, "detector": detector}

if __name__ == "__main__":
    measure_runs("from_labels", __doc__, RUNS, threads=THREADS)

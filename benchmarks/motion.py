"""Tissue that breathes: `make motion`.

The demo scene, displaced by a field that is known, stands for the patient: a sweep goes back and forth over it through
eight breaths, so that its frames cross at other phases. A scene of the same sweep over still tissue is the mark to
reach; one that is trained as if the tissue were still stands beside, and one whose numbers are found in the frames. The
field is compared where the sweep's frames cross, along depth, less the phase at which each scene is at rest. Cost:
frames of 100,000 Gaussians, still and moved by turns, of which the processor's time counts.
"""

from __future__ import annotations

import time
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from measuring import Document, Lines, columns, measure_runs
from ultragray import GaussianScene, LinearProbe, render
from ultragray.learn.motion import find_motion, fit_motion
from ultragray.learn.sweep import Dataset, Sweep
from ultragray.learn.training import TrainingConfig, train
from ultragray.phantom.demo import DEMO_PROBE, load_demo_scene
from ultragray.phantom.sweeps import freehand_poses
from ultragray.scene.deformation import Displacement
from ultragray.scene.motion_settings import FIT_STEPS

THREADS = 2
SIDE, PASSES, FRAMES, HELD_OUT = 96, 4, 40, 24
BREATHS, DEPTH_MM = 8, 6.0
FIRST_STEPS = 300  # of the training that the fit begins with; the marks are trained by as many as both together


def truth(numbers: np.ndarray) -> Displacement:  # [F] from 0 to 1
    """Deep tissue goes away from the skin, and a little along the spine, more to one side."""
    grid = torch.zeros((1, 8, 8, 8, 3))
    x, y, z = torch.meshgrid(*(torch.linspace(-1.0, 1.0, 8),) * 3, indexing="ij")
    grid[0, ..., 2] = DEPTH_MM * (0.5 + 0.5 * z) * (1.0 - 0.2 * x)
    grid[0, ..., 1] = 0.3 * DEPTH_MM * torch.cos(1.5 * y)
    spacing = np.array([80.0, 100.0, 90.0]) / 7.0
    shares = torch.from_numpy(numbers.astype(np.float32))[:, None, None, None, None]
    return Displacement.on_grid(shares * grid, (-40.0, -50.0, -10.0), spacing)


def sweep_of(patient: GaussianScene, poses: np.ndarray, numbers: np.ndarray) -> Sweep:
    parts = [
        render(
            patient.under(truth(numbers[first : first + 8])),
            DEMO_PROBE,
            poses[first : first + 8],
            height=SIDE,
            width=SIDE,
            outputs=("bmode",),
        ).bmode
        for first in range(0, len(poses), 8)
    ]
    images = (255.0 * torch.cat(parts)).round().to(torch.uint8).numpy()
    return Sweep(images, poses, DEMO_PROBE, np.arange(len(poses)), "the breathing demo scene")


def psnr_db(scene: GaussianScene, held_out: Sweep, numbers: np.ndarray | None) -> float:
    errors = []
    for place, image in enumerate(held_out.images):
        phase_scene = scene if numbers is None else scene.at_phase((float(numbers[place]),))
        size = {"height": SIDE, "width": SIDE}
        frame = render(phase_scene, DEMO_PROBE, held_out.poses[place], **size, outputs=("bmode",)).bmode[0].numpy()
        errors.append(-10.0 * np.log10(np.square(frame - image / 255.0).mean()))
    return round(float(np.mean(errors)), 2)


class Recording(NamedTuple):
    poses: np.ndarray  # [F, 4, 4]
    numbers: np.ndarray  # [F]
    breathing: Sweep
    held_out: Sweep
    held_numbers: np.ndarray


@cache
def recorded() -> Recording:
    patient = load_demo_scene()
    passes = [freehand_poses(FRAMES, offset_mm=2.0 * k, unrest=0.7 * k)[:: 1 - 2 * (k % 2)] for k in range(PASSES)]
    poses = np.concatenate(passes)
    numbers = 0.5 - 0.5 * np.cos(2.0 * np.pi * BREATHS * np.arange(len(poses)) / len(poses) + 0.3)
    held_poses = freehand_poses(HELD_OUT, offset_mm=3.0, unrest=2.0)
    held_numbers = np.random.default_rng(1).uniform(0.0, 1.0, HELD_OUT)
    breathing, held_out = sweep_of(patient, poses, numbers), sweep_of(patient, held_poses, held_numbers)
    return Recording(poses, numbers, breathing, held_out, held_numbers)


def trained(name: str, sweep: Sweep, held_out: Sweep, steps: int) -> GaussianScene:
    config = TrainingConfig(steps=steps, max_gaussians=8000, effort=1.0, confidence=False)
    return train(Dataset(name, sweep, held_out), config)


def found_numbers(_: Path) -> Document:
    """Numbers that nobody told; those of held-out frames follow from the true ones by a straight line."""
    _, numbers, breathing, held_out, held_numbers = recorded()
    moving, own = find_motion(trained("first", breathing, held_out, FIRST_STEPS), breathing)
    slope, begin = np.polyfit(numbers, own, 1)
    return {
        "correlation": round(float(np.corrcoef(own, numbers)[0, 1]), 3),
        "psnr_db": psnr_db(moving, held_out, np.clip(slope * held_numbers + begin, -1.0, 2.0)),
    }


def learned(_: Path) -> Document:
    poses, numbers, breathing, held_out, held_numbers = recorded()
    rest, patient = np.full(len(poses), 0.5), load_demo_scene()
    still = sweep_of(patient, poses, rest)
    still_held = sweep_of(patient, held_out.poses, rest[:HELD_OUT])
    marks = {
        "still": trained("still", still, still_held, FIRST_STEPS + FIT_STEPS),
        "static": trained("static", breathing, held_out, FIRST_STEPS + FIT_STEPS),
        "first": trained("first", breathing, held_out, FIRST_STEPS),
    }
    moving = fit_motion(marks["first"], breathing, numbers)
    # Points of the frames that have tissue, at rest in either scene: from there to full breath.
    corners = poses[::5, :3, 3][:, None] + poses[::5, :3, 2][:, None] * np.linspace(12.0, 45.0, 8)[:, None]
    points = torch.from_numpy(corners.reshape(-1, 3)).float()
    (mode,) = moving.info.motion.modes
    at_rest = truth(np.array([mode.rest])).at(points)[0]
    full = truth(np.array([1.0]))
    wanted = full.at(points)[0] - at_rest
    displacements = moving.at_phase((1.0,)).displacements[0].at(points + at_rest)[0]
    off = (displacements - wanted).numpy()
    return {
        "gaussians": moving.gaussian_count,
        "frames": len(poses),
        "depth_mm": DEPTH_MM,
        "psnr_db": {
            "still tissue": psnr_db(marks["still"], still_held, None),
            "static training": psnr_db(marks["static"], held_out, None),
            "with motion": psnr_db(moving, held_out, held_numbers),
        },
        "field_rms_mm": round(float(np.sqrt(np.square(off).sum(axis=1).mean())), 3),
        "field_rms_mm_in_plane": round(float(np.sqrt(np.square(off[:, [0, 2]]).sum(axis=1).mean())), 3),
    }


def cost(_: Path) -> Document:
    generator, count = torch.Generator().manual_seed(0), 100_000
    splats = {
        "means": (torch.rand((count, 3), generator=generator) - 0.5) * 5.0 + torch.tensor([0.0, 0.0, 2.5]),
        "scales": torch.log(0.05 * torch.exp(0.3 * torch.randn((count, 3), generator=generator))),
        "quats": torch.randn((count, 4), generator=generator),
        "transmittances": 4.0 + torch.randn(count, generator=generator),
        "sh0": 0.3 * torch.randn((count, 1, 1), generator=generator) - 0.5,
        "shN": torch.zeros((count, 3, 1)),
    }
    scene, probe = GaussianScene.from_splats(splats), LinearProbe(width_mm=50.0, near_mm=0.0, far_mm=50.0)
    fields = [truth(np.array([share])) for share in np.linspace(-0.5, 0.5, 10)]
    took: dict[str, list[tuple[float, float]]] = {"still": [], "moving": []}
    for turn in range(300):
        for name, one_scene in (("still", scene), ("moving", scene.under(fields[turn % len(fields)]))):
            before = time.perf_counter(), time.process_time()
            render(one_scene, probe, np.eye(4), height=512, width=512, outputs=("bmode",))
            took[name].append((time.perf_counter() - before[0], time.process_time() - before[1]))
    medians = {name: 1e3 * np.median(np.array(one), axis=0) for name, one in took.items()}
    more = 1e3 * np.median(np.array(took["moving"]) - np.array(took["still"]), axis=0)
    return {
        "gaussians": count,
        **{f"{name}_ms": round(float(one[0]), 2) for name, one in medians.items()},
        **{f"{name}_processor_ms": round(float(one[1]), 2) for name, one in medians.items()},
        "more_ms": round(float(more[0]), 2),
        "more_processor_ms": round(float(more[1]), 2),
    }


def lines(measured: Document) -> Lines:
    """The table of the documents."""
    learned, cost, by_search = measured["learned"], measured["cost"], measured.get("found")
    rows = [
        *((f"Held-out PSNR, {name}, dB", f"{psnr:.2f}") for name, psnr in learned["psnr_db"].items()),
        *(() if by_search is None else [("Held-out PSNR, numbers found, dB", f"{by_search['psnr_db']:.2f}")]),
        *(
            ()
            if by_search is None
            else [("Correlation of numbers found with the true ones", f"{by_search['correlation']:.2f}")]
        ),
        (
            "Field at full breath, root mean square error along the frames; in space, mm",
            f"{learned['field_rms_mm_in_plane']:.2f}; {learned['field_rms_mm']:.2f}",
        ),
        (f"Frame of {cost['gaussians']:,} Gaussians, still; moving, ms", f"{cost['still_ms']}; {cost['moving_ms']}"),
        (
            "Difference of the two, ms; of the processor's time, both threads, ms",
            f"{cost['more_ms']}; {cost['more_processor_ms']}",
        ),
    ]
    return columns([{"what": what, "found": value} for what, value in rows], {"Measured": "{what}", "": "{found}"})


if __name__ == "__main__":
    measure_runs("motion", __doc__, {"learned": learned, "found": found_numbers, "cost": cost}, threads=THREADS)

"""Scores of held-out frames whose poses may be wrong: each is registered by one half and scored on the other half.

A frame whose pose is off by a millimetre scores badly even in a perfect scene. Registering all of it first would score
the scene too well, so a frame is moved by its left half alone and scored on its right half, and the other way round.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import torch
from torch import Tensor

from ultragray.datasets.sweep import Sweep
from ultragray.errors import DatasetInvalid
from ultragray.evaluation.scoring import frames_at_once, require_frames
from ultragray.rendering import render
from ultragray.scene import GaussianScene
from ultragray.training.poses.trained import Corrections
from ultragray.training.steps.losses import SSIM_WINDOW, image_loss

STEPS = 60
TEXTURE = 0.5  # share of SSIM in the loss that a frame is moved by
RATE = 0.1  # mm a step, falling to 0


@dataclass(frozen=True)
class HalvesScore:
    """Mean PSNR of the halves of held-out frames, dB, and by how much registration moved their middles, mm."""

    as_given_psnr_db: float
    registered_psnr_db: float
    moved_mm: float

    def to_dict(self) -> dict[str, float]:
        """A JSON object."""
        return asdict(self)

    def __str__(self) -> str:
        return (
            f"halves of frames: {self.as_given_psnr_db:.2f} dB as given, {self.registered_psnr_db:.2f} dB registered "
            f"by the other half, which moved them by {self.moved_mm:.2f} mm"
        )


def score_halves(scene: GaussianScene, sweep: Sweep, *, backend: str = "auto") -> HalvesScore:
    """Of all frames of a sweep. Raises DatasetInvalid where there are none, or halves are too narrow to compare."""
    require_frames(sweep)
    middle = sweep.width // 2
    if min(middle, sweep.height) < SSIM_WINDOW:
        raise DatasetInvalid(
            f"{sweep.source}: to be registered by halves, frames must have at least {SSIM_WINDOW} rows and "
            f"{2 * SSIM_WINDOW} columns, got {sweep.height}x{sweep.width}"
        )
    halves = (slice(0, middle), slice(middle, sweep.width))
    given, registered, moved = [], [], []
    count = frames_at_once(sweep.height, sweep.width)
    for first in range(0, len(sweep), count):
        some = sweep.select(np.arange(first, min(first + count, len(sweep))))
        truth = torch.from_numpy(some.images).to(scene.means.device).float() / 255.0
        as_given = _rendered(scene, some, torch.from_numpy(some.poses), backend).detach()
        for fitted, scored in (halves, halves[::-1]):
            poses = _fitted(scene, some, truth, fitted, backend)
            given.append(_psnr_db(as_given[..., scored], truth[..., scored]))
            registered.append(_psnr_db(_rendered(scene, some, poses, backend)[..., scored], truth[..., scored]))
            centre = torch.from_numpy(np.append(sweep.probe.corners_mm().mean(axis=0), 1.0))
            moved.append(((poses - torch.from_numpy(some.poses)) @ centre).norm(dim=1))
    return HalvesScore(*(float(torch.cat(part).mean()) for part in (given, registered, moved)))


def _fitted(scene: GaussianScene, sweep: Sweep, truth: Tensor, columns: slice, backend: str) -> Tensor:  # [F, 4, 4]
    corrections = Corrections(sweep, [[place] for place in range(len(sweep))])
    places = torch.arange(len(sweep))
    target = truth[..., columns].contiguous()
    for step in range(STEPS):
        frames = _rendered(scene, sweep, corrections.corrected(places, sweep.poses), backend)
        (len(sweep) * image_loss(frames[..., columns].contiguous(), target, TEXTURE)).backward()  # type: ignore[no-untyped-call]
        corrections.update(RATE * (1.0 - step / STEPS))
    return corrections.corrected(places, sweep.poses).detach()


def _rendered(scene: GaussianScene, sweep: Sweep, poses: Tensor, backend: str) -> Tensor:  # [F, H, W]
    height, width = sweep.height, sweep.width
    return render(scene, sweep.probe, poses, height=height, width=width, outputs=("bmode",), backend=backend)["bmode"]


def _psnr_db(frames: Tensor, truth: Tensor) -> Tensor:  # [F, H, W] both -> [F]
    return -10.0 * (frames.detach() - truth).square().mean(dim=(1, 2)).clamp(min=1e-10).log10().cpu()

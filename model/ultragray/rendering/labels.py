"""The label of each pixel: the one whose Gaussians weigh most there (docs/physics.md §3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ultragray.scene.gaussians import GaussianScene

MIN_WEIGHT_SUM = 1.0 / 255.0  # a label with less is not seen

WeightSum = Callable[[GaussianScene], Tensor]  # S of each pixel of a scene, [C, H, W]


def render_labels(scene: GaussianScene, shape: tuple[int, int, int], weight_sum: WeightSum) -> Tensor:
    """argmax over l of S_l, the sum of w over the Gaussians of label l, [C, H, W] uint8; 0 where no S_l reaches 1/255.

    Gaussians without a label are those of label 0. Of labels that weigh the same, the smallest is taken.
    """
    found = torch.zeros(shape, dtype=torch.uint8, device=scene.means.device)
    heaviest = scene.means.new_zeros(shape)
    with torch.no_grad():
        for label, part in scene.prepared("labels", lambda: _parts(scene)):
            _keep_heavier(found, heaviest, label, weight_sum(part))
    return found


def _keep_heavier(found: Tensor, heaviest: Tensor, label: int, weight: Tensor) -> None:  # [C, H, W] each
    """Puts a label where it weighs more than those before it, and what it weighs there."""
    if found.is_cuda:
        heavier = (weight > heaviest) & (weight >= MIN_WEIGHT_SUM)
        found.masked_fill_(heavier, label)
        heaviest.copy_(torch.where(heavier, weight, heaviest))
    else:  # by numpy: on a busy machine the threads of torch wait for each other longer than a frame takes
        most, own = heaviest.numpy(), weight.numpy()
        more = (own > most) & (own >= MIN_WEIGHT_SUM)
        np.copyto(found.numpy(), np.uint8(label), where=more)
        np.copyto(most, own, where=more)


def _parts(scene: GaussianScene) -> list[tuple[int, GaussianScene]]:
    """The Gaussians of each label that occurs, as scenes of their own; their intensities do not matter."""
    if scene.labels is None:
        return []
    parts = []
    for label in torch.unique(scene.labels).tolist():
        chosen = scene.labels == label
        splats: dict[str, Any] = {name: raw.detach()[chosen] for name, raw in scene.splats.items() if name != "shN"}
        splats["shN"] = splats["sh0"][:, :0]
        info = replace(scene.info, sh_degree=0, gaussian_count=len(splats["means"]), label_names={})
        parts.append((label, GaussianScene(**splats, info=info)))
    return parts

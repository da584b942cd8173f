"""Sums over Gaussians that have a weight each and absorb nothing, as density-normalised methods need them.

The raw parameter `transmittances` holds logits of weights here: α = σ(raw), w = α·exp(−½ m²), which the kernels take as
an offset of the squared Mahalanobis distance, m² − 2·ln α. All else is as for the Gaussians of a scene
(docs/physics.md §3): w is at most 0.999, a Gaussian counts where w ≥ 1/255, and not at all with its mean before the
face or beyond the last row.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from ultragray.errors import BackendUnavailable
from ultragray.geometry.probe import Probe
from ultragray.rendering.backends import cpu, cuda, reference
from ultragray.rendering.backends.inputs import ScenePoses
from ultragray.rendering.limits import UNLIMITED
from ultragray.rendering.outputs import INTENSITY_SUM, SUMS, WEIGHT_SUM
from ultragray.scene.gaussians import GaussianScene

_BACKENDS = {
    "reference": reference.render_outputs,
    "cpu": cpu.render_outputs,
    "cuda": cuda.render_outputs,
}


class WeightedSums(NamedTuple):
    """S = Σ w and Σ I·w of each pixel, [C, H, W] each."""

    weight: Tensor
    intensity: Tensor


def weighted_sums(
    scene: GaussianScene,
    probe: Probe,
    poses_cm: ScenePoses,  # [C, 4, 4] about the scene's centre
    height: int,
    width: int,
    backend: str,
) -> WeightedSums:
    """The sums of a scene whose transmittances are logits of weights, by one of the three backends, differentiable.

    Raises BackendUnavailable for another one.
    """
    if backend not in _BACKENDS:
        raise BackendUnavailable(f"backend must be one of {', '.join(_BACKENDS)}, got {backend!r}", field="backend")
    planes = _BACKENDS[backend](scene, probe, poses_cm, height, width, SUMS, UNLIMITED, None, weighted=True)
    return WeightedSums(planes[WEIGHT_SUM], planes[INTENSITY_SUM])

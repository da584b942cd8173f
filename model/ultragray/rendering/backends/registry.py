"""The backends by name: which draws a scene, where its scenes must lie, and what frames call it.

A backend draws planes [C, H, W] of a scene (docs/physics.md §3). All share one signature and one suite of tests; the
reference is the definition. `render` of `ultragray.rendering.frames` puts the planes together to outputs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ultragray.errors import BackendUnavailable
from ultragray.geometry.probe import Probe
from ultragray.installation import __version__
from ultragray.rendering.backends import cpu, cuda, reference
from ultragray.rendering.backends.inputs import ScenePoses
from ultragray.rendering.limits import UNLIMITED
from ultragray.rendering.outputs import INTENSITY_SUM, SUMS, WEIGHT_SUM
from ultragray.scene.gaussians import GaussianScene


@dataclass(frozen=True)
class Backend:
    """One way to draw planes."""

    # planes by name, [C, H, W] each: scene, probe, poses in cm [C, 4, 4], height, width, planes, limits, beam
    draw: Callable[..., dict[str, Tensor]]
    # B-mode in 8 bits and shares of supported pixels, as `cpu.render_grey`; None: by way of planes
    draw_grey: Callable[..., tuple[Tensor, npt.NDArray[np.float32]]] | None = None
    # whether it can draw a scene, which depends on where its tensors lie, and of which type they are
    supports: Callable[[GaussianScene], bool] = lambda _: True
    require: Callable[[], None] = lambda: None  # raises BackendUnavailable where it cannot draw here
    place: Callable[[], str] = lambda: "anywhere"  # where it draws float32 scenes, in words
    renderer: Callable[[GaussianScene], str] = lambda _: "reference"  # what the frames of a scene call it


BACKENDS: dict[str, Backend] = {
    "reference": Backend(reference.render_outputs),
    "cpu": Backend(
        cpu.render_outputs,
        cpu.render_grey,
        supports=cpu.supports,
        place=lambda: "on the CPU",
        renderer=lambda _: f"cpu-{cpu.INSTRUCTION_SETS[0]}",
    ),
    "cuda": Backend(
        cuda.render_outputs,
        supports=cuda.supports,
        require=cuda.require,
        place=lambda: f"on the device {cuda.device()}",
        renderer=lambda scene: cuda.renderer(scene.means.device),
    ),
}


def choose_backend(name: str, scene: GaussianScene) -> str:
    """The backend that `name` (auto: the best) means for a scene.

    Raises BackendUnavailable for an unknown name and for one that cannot render the scene here.
    """
    if name == "auto":
        if scene.means.is_cuda and cuda.supports(scene):
            return "cuda"
        return "cpu" if cpu.supports(scene) else "reference"
    if name not in BACKENDS:
        raise BackendUnavailable(f"backend must be one of auto, {', '.join(BACKENDS)}, got {name!r}", field="backend")
    backend = BACKENDS[name]
    backend.require()
    if name == "cuda" and scene.displacements:
        raise BackendUnavailable("backend cuda draws tissue at rest alone: ask for auto, or reference", field="backend")
    if not backend.supports(scene):
        raise BackendUnavailable(
            f"backend {name} renders float32 scenes {backend.place()}, got {scene.means.dtype} on {scene.means.device}",
            field="backend",
        )
    return name


def renderer_name(backend: str, scene: GaussianScene) -> str:
    """The name of a scene's renderer, as in every frame: `ultragray/0.1.0 cpu-avx512`, `ultragray/0.1.0 cuda-sm90`."""
    return f"ultragray/{__version__} {BACKENDS[choose_backend(backend, scene)].renderer(scene)}"


def render_device(backend: str, number: int = 0) -> torch.device:
    """Where the scenes of a backend must lie: GPU `number`, counted round and round, for `cuda` and, where there is
    one, for `auto`; else the CPU. Raises BackendUnavailable for `cuda` where there is none.
    """
    if backend == "cuda" or (backend == "auto" and cuda.available()):
        return cuda.device(number % max(1, cuda.device_count()))
    return torch.device("cpu")


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
    """Sums over Gaussians that have a weight each and absorb nothing, as density-normalised methods need them.

    The raw parameter `transmittances` holds logits of weights here: α = σ(raw), w = α·exp(−½ m²), which the kernels
    take as an offset of the squared Mahalanobis distance, m² − 2·ln α. All else is as for the Gaussians of a scene
    (docs/physics.md §3): w is at most 0.999, a Gaussian counts where w ≥ 1/255, and not at all with its mean before
    the face or beyond the last row. Differentiable. Raises BackendUnavailable for an unknown backend.
    """
    if backend not in BACKENDS:
        raise BackendUnavailable(f"backend must be one of {', '.join(BACKENDS)}, got {backend!r}", field="backend")
    planes = BACKENDS[backend].draw(scene, probe, poses_cm, height, width, SUMS, UNLIMITED, None, weighted=True)
    return WeightedSums(planes[WEIGHT_SUM], planes[INTENSITY_SUM])

"""render(): poses in, frames out, on the backend that fits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from . import __version__, cpu, reference
from .errors import BackendUnavailable
from .pose import check_poses
from .probe import FloatArray, Probe
from .request import OUTPUTS, check_image_size, check_outputs
from .scene import GaussianScene

Backend = Callable[[GaussianScene, Probe, FloatArray, int, int, Sequence[str]], dict[str, Tensor]]


@dataclass(frozen=True)
class Frames:
    """Rendered frames, each [C, H, W] in [0, 1] or None where it was not asked for.

    bmode B = E·T, echo E, transmittance T, coverage γ = 1 − exp(−S) (docs/physics.md §3).
    """

    bmode: Tensor | None = None
    echo: Tensor | None = None
    transmittance: Tensor | None = None
    coverage: Tensor | None = None


def render(
    scene: GaussianScene,
    probe: Probe | None,
    poses: Any,  # [C, 4, 4] or [4, 4] mm, probe→scene
    *,
    height: int,
    width: int,
    outputs: Sequence[str] = OUTPUTS,
    backend: str = "auto",
) -> Frames:
    """Frames [C, height, width] of a scene seen by `probe` (None: the probe the scene was trained with) from `poses`.

    Poses are rigid probe→scene transforms in mm, in the frame of the sweep that the scene was trained from.
    Backends: `reference` computes in the dtype of the scene's tensors; `cpu` computes in float32 on as many threads as
    torch.get_num_threads(); `auto` takes `cpu` for float32 scenes on the CPU. Both are differentiable with respect to
    the scene's tensors (`cpu` once); the gradients are the true ones (docs/physics.md §4).
    Raises InvalidPose, InvalidProbe, InvalidImageSize, UnknownOutput, BackendUnavailable.
    """
    chosen = check_outputs(outputs)
    check_image_size(height, width)
    probe = scene.info.probe_or(probe)
    poses_cm = scene.poses_to_scene_cm(check_poses(poses))
    backend = choose_backend(backend, scene)
    return Frames(**_BACKENDS[backend](scene, probe, poses_cm, height, width, chosen))


_BACKENDS: dict[str, Backend] = {"reference": reference.render_outputs, "cpu": cpu.render_outputs}


def choose_backend(name: str, scene: GaussianScene) -> str:
    """The backend that `name` (auto: the best) means for a scene. Raises BackendUnavailable for an unknown name."""
    if name == "auto":
        return "cpu" if cpu.supports(scene) else "reference"
    if name not in _BACKENDS:
        raise BackendUnavailable(f"backend must be one of auto, {', '.join(_BACKENDS)}, got {name!r}", field="backend")
    return name


def renderer_name(backend: str, scene: GaussianScene) -> str:
    """What renders a scene, as every frame says it: `ultragray/0.1.0 cpu-avx512`."""
    chosen = choose_backend(backend, scene)
    return f"ultragray/{__version__} {f'cpu-{cpu.INSTRUCTION_SETS[0]}' if chosen == 'cpu' else chosen}"

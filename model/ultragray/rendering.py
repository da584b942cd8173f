"""render(): poses in, frames out, on the backend that fits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from . import __version__
from .backends import cpu, cuda, reference
from .backends.labels import render_labels
from .errors import BackendUnavailable
from .pose import check_poses
from .probe import FloatArray, Probe
from .request import LABELS, OUTPUTS, WEIGHT_SUM, check_image_size, check_labelled, check_outputs
from .scene import GaussianScene

Backend = Callable[[GaussianScene, Probe, FloatArray, int, int, Sequence[str]], dict[str, Tensor]]


@dataclass(frozen=True)
class Frames:
    """Rendered frames, each [C, H, W] or None where it was not asked for.

    In [0, 1]: bmode B = E·T, echo E, transmittance T, coverage γ = 1 − exp(−S) (docs/physics.md §3). uint8: labels, of
    which `scene.info.label_names` tells the meaning; 0 where there is none.
    """

    bmode: Tensor | None = None
    echo: Tensor | None = None
    transmittance: Tensor | None = None
    coverage: Tensor | None = None
    labels: Tensor | None = None


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
    Backends: `reference` computes in the dtype of the scene's tensors, where they are; `cpu` in float32 on as many
    threads as torch.get_num_threads(); `cuda` in float32 on the GPU that holds the scene (`scene.to("cuda")`). `auto`
    takes the fast one for where the scene is. All are differentiable with respect to the scene's tensors (`cpu` and
    `cuda` once), labels apart; the gradients are the true ones (docs/physics.md §4).
    Raises InvalidPose, InvalidProbe, InvalidImageSize, UnknownOutput (also for labels of a scene that carries none),
    BackendUnavailable, and MemoryExceeded where the GPU's memory does not suffice.
    """
    chosen = check_outputs(outputs)
    check_labelled(chosen, scene.info)
    check_image_size(height, width)
    height, width = int(height), int(width)
    probe = scene.info.probe_or(probe)
    poses_cm = scene.poses_to_scene_cm(check_poses(poses))
    draw = _BACKENDS[choose_backend(backend, scene)]
    names = [name for name in chosen if name != LABELS]
    frames = draw(scene, probe, poses_cm, height, width, names) if names else {}
    if LABELS in chosen:
        frames[LABELS] = render_labels(
            scene,
            (len(poses_cm), height, width),
            lambda part: draw(part, probe, poses_cm, height, width, (WEIGHT_SUM,))[WEIGHT_SUM],
        )
    return Frames(**frames)


_BACKENDS: dict[str, Backend] = {
    "reference": reference.render_outputs,
    "cpu": cpu.render_outputs,
    "cuda": cuda.render_outputs,
}


def choose_backend(name: str, scene: GaussianScene) -> str:
    """The backend that `name` (auto: the best) means for a scene.

    Raises BackendUnavailable for an unknown name and for one that cannot render the scene here.
    """
    if name == "auto":
        if scene.means.is_cuda and cuda.supports(scene):
            return "cuda"
        return "cpu" if cpu.supports(scene) else "reference"
    if name not in _BACKENDS:
        raise BackendUnavailable(f"backend must be one of auto, {', '.join(_BACKENDS)}, got {name!r}", field="backend")
    if name == "cuda":
        cuda.require()
    if name != "reference" and not (cpu if name == "cpu" else cuda).supports(scene):
        place = "on the CPU" if name == "cpu" else f"on the device {cuda.device()}"
        raise BackendUnavailable(
            f"backend {name} renders float32 scenes {place}, got {scene.means.dtype} on {scene.means.device}",
            field="backend",
        )
    return name


def renderer_name(backend: str, scene: GaussianScene) -> str:
    """What renders a scene, as every frame says it: `ultragray/0.1.0 cpu-avx512`, `ultragray/0.1.0 cuda-sm90`."""
    chosen = choose_backend(backend, scene)
    if chosen == "cpu":
        by = f"cpu-{cpu.INSTRUCTION_SETS[0]}"
    else:
        by = cuda.renderer(scene.means.device) if chosen == "cuda" else chosen
    return f"ultragray/{__version__} {by}"

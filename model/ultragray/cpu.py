"""The CPU backend: the C++ kernel of docs/physics.md §5 behind the signature that all backends share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from . import _cpu
from .errors import BackendUnavailable
from .probe import ConvexProbe, FloatArray, Probe
from .scene import GaussianScene

INSTRUCTION_SETS: tuple[str, ...] = tuple(_cpu.instruction_sets())  # what this processor can run, best first


def supports(scene: GaussianScene) -> bool:
    """Whether this backend can render the scene: float32 on the CPU, no gradient wanted."""
    tensors = scene.splats.values()
    differentiable = torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
    return scene.means.device.type == "cpu" and scene.means.dtype == torch.float32 and not differentiable


def render_outputs(
    scene: GaussianScene,
    probe: Probe,
    poses_cm: FloatArray,  # [C, 4, 4] about the scene's centre
    height: int,
    width: int,
    outputs: Sequence[str],
    *,
    instruction_set: str = "auto",
) -> dict[str, Tensor]:
    """The outputs by name, each [C, H, W] float32. Raises BackendUnavailable for a scene it does not support."""
    if not supports(scene):
        raise BackendUnavailable(
            f"backend cpu renders float32 scenes on the CPU without gradients, got {scene.means.dtype} on "
            f"{scene.means.device}",
            field="backend",
        )
    if instruction_set != "auto" and instruction_set not in INSTRUCTION_SETS:
        raise BackendUnavailable(
            f"instruction_set must be auto or one of {', '.join(INSTRUCTION_SETS)}, got {instruction_set!r}",
            field="instruction_set",
        )
    frames = {name: torch.empty((len(poses_cm), height, width), dtype=torch.float32, device="cpu") for name in outputs}
    planes = {name: frames[name].numpy() if name in frames else None for name in _PLANES}
    convex = isinstance(probe, ConvexProbe)
    _cpu.render(
        _prepared(scene),
        convex=convex,
        width_cm=0.0 if isinstance(probe, ConvexProbe) else probe.width_mm / 10.0,
        opening_rad=math.radians(probe.opening_angle_deg) if isinstance(probe, ConvexProbe) else 0.0,
        near_cm=probe.near_mm / 10.0,
        far_cm=probe.far_mm / 10.0,
        cull_far_cm=probe.cull_far_mm(height) / 10.0,
        poses=np.ascontiguousarray(poses_cm),
        height=height,
        width=width,
        threads=torch.get_num_threads(),
        instruction_set=instruction_set,
        **planes,
    )
    return frames


_PLANES = ("bmode", "echo", "transmittance", "coverage")


class _Prepared(NamedTuple):
    """A prepared scene, and what it was prepared from: holding the tensors keeps their identity from being reused."""

    tensors: tuple[Tensor, ...]
    versions: tuple[int, ...]
    intensity: str
    scene: _cpu.PreparedScene


def _prepared(scene: GaussianScene) -> _cpu.PreparedScene:
    """The scene as the kernel wants it, kept with the scene until one of its tensors changes.

    A change that torch does not count (through `.data`) is not noticed.
    """
    tensors = tuple(scene.splats.values())
    if any(t.is_inference() for t in tensors):  # their changes are not counted
        return _prepare(scene)
    versions = tuple(t._version for t in tensors)
    kept: _Prepared | None = scene.cache.get("cpu")
    if (
        kept is None
        or kept.versions != versions
        or kept.intensity != scene.info.intensity
        or any(a is not b for a, b in zip(kept.tensors, tensors, strict=True))
    ):
        kept = _Prepared(tensors, versions, scene.info.intensity, _prepare(scene))
        scene.cache["cpu"] = kept  # one assignment: threads may render the scene at the same time
    return kept.scene


def _prepare(scene: GaussianScene) -> _cpu.PreparedScene:
    raw = {name: tensor.detach().contiguous() for name, tensor in scene.splats.items()}
    return _cpu.PreparedScene(
        raw["means"].numpy(),
        raw["scales"].numpy(),
        raw["quats"].numpy(),
        raw["transmittances"].numpy(),
        raw["sh0"].reshape(-1).numpy(),
        raw["shN"].squeeze(-1).numpy(),
        scene.sh_degree,
        scene.info.intensity == "sigmoid",
    )

"""The CUDA backend: the forward model and its gradient as Triton kernels (docs/physics.md §8).

Importing this package imports neither Triton nor a CUDA context; the first frame does.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from ultragray.geometry.probe import Probe
from ultragray.rendering.backends.cuda.device import (
    available,
    device,
    device_count,
    interpreted,
    renderer,
    require,
    supports,
    upload,
)
from ultragray.rendering.backends.inputs import ScenePoses
from ultragray.rendering.limits import UNLIMITED, Limits
from ultragray.scene.gaussians import GaussianScene

__all__ = [
    "available",
    "device",
    "device_count",
    "interpreted",
    "render_outputs",
    "renderer",
    "require",
    "supports",
    "upload",
]


def render_outputs(
    scene: GaussianScene,
    probe: Probe,
    poses_cm: ScenePoses,  # [C, 4, 4] about the scene's centre
    height: int,
    width: int,
    outputs: Sequence[str],
    limits: Limits = UNLIMITED,
    beam: Tensor | None = None,  # [3] cm, see `beam.beam_cm`
    *,
    weighted: bool = False,  # see `registry.weighted_sums`
) -> dict[str, Tensor]:
    """The outputs by name, each [C, H, W] float32 on the scene's device; differentiable once by every parameter and
    by poses and the beam.

    The scene is one that the backend supports. Nothing here waits for the device, but where the cost of frames has a
    limit, and the gradient by a beam; limits hold for frames without gradients.
    Raises MemoryExceeded where the device's memory does not suffice, FrameTooCostly and GivenUp.
    """
    from ultragray.rendering.backends.cuda.frames import render_frames

    return render_frames(scene, probe, poses_cm, height, width, outputs, limits, beam, weighted)

"""Scenes, poses, scan lines and beams as all backends take them, in cm, and the way back for gradients.

`ultragray.rendering.frames` makes them once for a call, whichever backend draws.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor

from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import (
    FWHM_PER_SIGMA,
    ElevationBeam,
    FannedLines,
    FloatArray,
    ParallelLines,
    Probe,
    RadialLines,
)
from ultragray.scene.gaussians import GaussianScene


class Kind(NamedTuple):
    """How intensities are activated, and whether Gaussians have weights instead of transmittances."""

    intensity: str  # of scene_info.INTENSITIES
    weighted: bool = False  # see `registry.weighted_sums`

    def place(self, backend: str) -> str:
        """The name under which a scene keeps what a backend prepared of it."""
        return f"{backend}, weighted" if self.weighted else backend


ScenePoses: TypeAlias = FloatArray | Tensor  # [C, 4, 4]; a tensor, float64 on the CPU, where it wants a gradient


def scene_poses(scene: GaussianScene, poses: Any) -> ScenePoses:  # [C, 4, 4] or [4, 4] mm -> [C, 4, 4] cm
    """Poses of the sweep's frame, made exactly rigid, in the scene's own; the graph of a tensor is kept.

    Where tissue followed the probe, its gradient is that of a probe that slides over it. Raises InvalidPose.
    """
    exact = check_poses(poses)
    exact_cm = scene.poses_to_scene_cm(scene.poses_at_rest(exact))
    if isinstance(poses, Tensor) and poses.requires_grad and torch.is_grad_enabled():
        poses_cm: Tensor = _Rigid.apply(poses, exact, exact_cm)  # type: ignore[no-untyped-call]
        return poses_cm
    return exact_cm


def want_gradient(poses: ScenePoses) -> bool:
    return isinstance(poses, Tensor) and poses.requires_grad and torch.is_grad_enabled()


def as_array(poses: ScenePoses) -> FloatArray:  # [C, 4, 4]
    return poses.detach().numpy() if isinstance(poses, Tensor) else poses


def gradient_by_poses(poses: Tensor, by_motion: Tensor) -> Tensor:  # [C, 4, 4], [C, 2, 3] -> [C, 4, 4]
    """By the entries of poses, from what kernels give: by a shift (cm) and a turn (radians, about the probe's origin).

    A turn ω moves a rotation R by [ω]R; of all matrices whose product with that is the same, ½[turn]R is the shortest.
    """
    by_poses = torch.zeros_like(poses)
    by_poses[:, :3, 3] = by_motion[:, 0]
    by_poses[:, :3, :3] = 0.5 * torch.linalg.cross(by_motion[:, 1, :, None], poses[:, :3, :3], dim=1)
    return by_poses


class _Rigid(torch.autograd.Function):
    """The nearest rigid transforms and their change of units.

    What a frame is for a matrix that is no rotation is not defined, so the gradient by the nine entries of a rotation R
    is that of the nearest rotation: of dL/dR the part R·A with A antisymmetric, which every way of moving a rotation
    sees (docs/physics.md §4). Exact for a rotation; within 1e-3 for one that had to be corrected by as much.
    """

    @staticmethod
    def forward(ctx: Any, poses: Tensor, exact: FloatArray, exact_cm: FloatArray) -> Tensor:
        ctx.like, ctx.rotations = poses.detach(), torch.from_numpy(exact[:, :3, :3])
        ctx.rotations_cm = torch.from_numpy(exact_cm[:, :3, :3])
        return torch.from_numpy(exact_cm)

    @staticmethod
    def backward(ctx: Any, by_cm: Tensor) -> tuple[Tensor, None, None]:
        rotations, by_poses = ctx.rotations, torch.zeros_like(by_cm)
        by_turn = ctx.rotations_cm.transpose(1, 2) @ by_cm[:, :3, :3]
        by_poses[:, :3, :3] = rotations @ (by_turn - by_turn.transpose(1, 2)) / 2.0
        back = rotations @ ctx.rotations_cm.transpose(1, 2)  # the identity, but where tissue followed the probe
        by_poses[:, :3, 3] = torch.einsum("cij,cj->ci", back, by_cm[:, :3, 3]) / 10.0
        return by_poses.reshape(ctx.like.shape).to(ctx.like), None, None


class KernelLines(NamedTuple):
    """A bundle of lines that run side by side along z, or fan out from the origin.

    Line j of W is at start + span·(j+½)/W, in cm along x or in radians from z towards +x. Lines that are parallel but
    not upright become so in a sheared plane: with x' = x − z·tan φ and z' = z/cos φ, a line is x' = const and z' the
    depth along it. How a Gaussian's weight falls along a line does not depend on the axes of the plane, so kernels need
    no more than its mean and covariance in sheared ones: `axes` takes the lateral, elevation and axial axis of a pose
    to those (docs/physics.md §3).
    """

    fanned: bool
    wrap: bool  # whether the first line follows the last, a full turn later
    start: float
    span: float
    axes: FloatArray  # [3, 3]

    @classmethod
    @lru_cache(maxsize=64)  # each frame asks for those of its probe
    def of(cls, probe: Probe) -> KernelLines:
        match probe.lines:
            case ParallelLines() as lines:
                along_x, along_z = lines.direction
                axes = np.eye(3)
                axes[2] = -along_x / along_z, 0.0, 1.0 / along_z
                return cls(False, False, lines.start / 10.0, lines.span / 10.0, axes)
            case FannedLines() | RadialLines() as lines:
                return cls(True, lines.wrap, math.radians(lines.start), math.radians(lines.span), np.eye(3))

    def view_axes(self, poses: FloatArray) -> FloatArray:  # [C, 4, 4] -> [C, 4, 4]
        sheared = poses.copy()
        sheared[:, :3, :3] = poses[:, :3, :3] @ self.axes
        return sheared


def beam_cm(beam: ElevationBeam | Tensor | None, probe: Probe) -> Tensor | None:
    """σ_f, s_f and z_R in cm, [3] float64 on the CPU; None for an infinitely thin slice.

    A tensor holds a beam's thickness, focus and depth of field in mm; gradients reach it.
    Raises InvalidArgument for one of another shape.
    """
    if beam is None or (isinstance(beam, ElevationBeam) and beam.thickness_mm == 0.0):
        return None
    if isinstance(beam, ElevationBeam):
        return _constant_beam_cm(beam, probe)
    if not isinstance(beam, Tensor) or beam.shape != (3,) or not beam.is_floating_point():
        raise InvalidArgument(
            "beam must be an ElevationBeam or a tensor [3] of its thickness, focus and depth of field in mm, got "
            f"{list(beam.shape) if isinstance(beam, Tensor) else type(beam).__name__}",
            field="beam",
        )
    thickness, focus, depth_of_field = beam.to("cpu", torch.float64).unbind()
    return torch.stack(
        [thickness / (10.0 * FWHM_PER_SIGMA), (focus + probe.face_depth_mm) / 10.0, depth_of_field / 20.0]
    )


@lru_cache(maxsize=64)  # each frame asks for that of its probe
def _constant_beam_cm(beam: ElevationBeam, probe: Probe) -> Tensor | None:
    return beam_cm(torch.tensor(beam.numbers, dtype=torch.float64), probe)


class Moments(NamedTuple):
    """The gradient of a loss with respect to σ_y², summed over Gaussians and poses, times powers of s − s_f."""

    zeroth: float
    first: float  # cm
    second: float  # cm²

    def gradient(self, beam: Tensor) -> Tensor:  # [3] cm -> [3]
        """By σ_f, s_f and z_R, from σ_y² = σ_f²·(1 + ((s − s_f)/z_R)²)."""
        sigma, _, rayleigh = beam.tolist()
        slope = sigma / rayleigh
        by_sigma = 2.0 * (sigma * self.zeroth + slope / rayleigh * self.second)
        return beam.new_tensor([by_sigma, -2.0 * slope**2 * self.first, -2.0 * slope**2 / rayleigh * self.second])


class BeamVariance(NamedTuple):
    """σ_y² by depth as the kernels evaluate it: at_focus + slope²·(s − focus)², in cm."""

    at_focus: float
    focus: float
    slope2: float
    most: float  # at the depths where means are not culled

    @classmethod
    def of(cls, beam: Tensor, probe: Probe, height: int) -> BeamVariance:
        sigma, focus, rayleigh = beam.tolist()
        slope2 = (sigma / rayleigh) ** 2
        ends = probe.near_mm / 10.0, probe.cull_far_mm(height) / 10.0
        offset = max(abs(end - focus) for end in ends) if slope2 else 0.0
        return cls(sigma**2, focus, slope2, sigma**2 + slope2 * offset**2)


THIN = BeamVariance(0.0, 0.0, 0.0, 0.0)


def spatial_order(means: Tensor) -> Tensor:  # [N, 3] -> [N]
    """The Gaussians along a Morton curve: the kernels cull neighbours together and find them in the cache."""
    if not len(means):
        return torch.zeros(0, dtype=torch.int64, device=means.device)
    low, high = means.detach().amin(dim=0), means.detach().amax(dim=0)
    cells = (1023.0 * (means.detach() - low) / (high - low).clamp(min=1e-12)).long()
    keys = torch.zeros(len(means), dtype=torch.int64, device=means.device)
    for bit in range(10):
        for axis in range(3):
            keys |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return torch.argsort(keys, stable=True)

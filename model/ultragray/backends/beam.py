"""The elevational beam as the backends take it: three numbers in cm, differentiable (docs/physics.md §3)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ultragray.errors import InvalidArgument
from ultragray.probe import ElevationBeam, Probe
from ultragray.probe.elevation import FWHM_PER_SIGMA


def beam_cm(beam: ElevationBeam | Tensor | None, probe: Probe) -> Tensor | None:
    """σ_f, s_f and z_R in cm, [3] float64 on the CPU; None for an infinitely thin slice.

    A tensor holds a beam's thickness, focus and depth of field in mm; gradients reach it.
    Raises InvalidArgument for one of another shape.
    """
    if beam is None or (isinstance(beam, ElevationBeam) and beam.is_thin):
        return None
    if isinstance(beam, ElevationBeam):
        beam = torch.tensor(beam.numbers, dtype=torch.float64)
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
        """Of the numbers of `beam_cm`, for frames of a height."""
        sigma, focus, rayleigh = beam.tolist()
        slope2 = (sigma / rayleigh) ** 2
        ends = probe.near_mm / 10.0, probe.cull_far_mm(height) / 10.0
        offset = max(abs(end - focus) for end in ends) if slope2 else 0.0
        return cls(sigma**2, focus, slope2, sigma**2 + slope2 * offset**2)


THIN = BeamVariance(0.0, 0.0, 0.0, 0.0)

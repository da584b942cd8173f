"""The average with a background and the shadow, against hand-computed values."""

import math

import numpy as np
import torch

from ultragray import LinearProbe
from ultragray.rendering.backends.registry import weighted_sums
from ultragray_studies.methods.ultragauss import Field, average, shadow

# One pixel, whose middle lies at the depth of 1 cm on the axis of the probe.
PROBE = LinearProbe(width_mm=2.0, near_mm=9.0, far_mm=11.0)
INTENSITIES = torch.tensor([0.2, 0.7], dtype=torch.float64)


def two_gaussians(weights, heights_cm):
    """Round, σ = 0.5 cm, above one another along elevation, at the depth of 0.95 cm."""
    gaussians = {
        "means": torch.tensor([[0.0, height, 0.95] for height in heights_cm]),
        "scales": torch.full((2, 3), math.log(0.5)),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2),
        "transmittances": torch.logit(torch.tensor(weights)),
        "sh0": (torch.logit(INTENSITIES) / (4.0 * 0.28209479177387814)).float().reshape(2, 1, 1),
    }
    return Field(gaussians, casts_shadow=False)


def one_pixel(field):
    with torch.no_grad():
        return weighted_sums(field.scene(np.zeros(3)), PROBE, np.eye(4)[None], 1, 1, "cpu")


def test_two_gaussians_on_one_pixel():
    field = two_gaussians((0.8, 0.3), (0.1, -0.4))
    # δ = (0, ∓height, 0.05) cm, A = 4 cm⁻²
    first = 0.8 * math.exp(-0.5 * 4.0 * (0.1**2 + 0.05**2))
    second = 0.3 * math.exp(-0.5 * 4.0 * (0.4**2 + 0.05**2))
    want = (first * 0.2 + second * 0.7 + 0.1 * 0.05) / (first + second + 0.1)
    got = average(*one_pixel(field), torch.tensor(0.1), torch.tensor(0.05))
    assert math.isclose(float(got), want, abs_tol=1e-6)


def test_the_shadow_is_the_sum_down_each_scan_line():
    weights = torch.tensor([[[1.0, 0.0], [2.0, 0.5], [0.0, 3.0]]])  # [1, 3, 2]
    got = shadow(weights, torch.tensor(0.5), 0.2)
    want = torch.exp(-0.5 * 0.2 * torch.tensor([[[1.0, 0.0], [3.0, 0.5], [3.0, 3.5]]]))
    assert torch.allclose(got, want, rtol=1e-6)

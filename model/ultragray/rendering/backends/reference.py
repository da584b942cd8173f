"""The forward model of docs/physics.md §3 in plain torch: the definition that every fast backend is tested against.

Written for reading. It computes in the dtype and on the device of the scene's tensors and is differentiable by
autograd; thresholds and culls are held fixed, everything else carries its true gradient (docs/physics.md §4). Lengths
are in cm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ultragray.geometry.probe import Probe
from ultragray.rendering.backends.cpu import footprint_pixels
from ultragray.rendering.backends.inputs import KernelLines, ScenePoses, as_array
from ultragray.rendering.limits import UNLIMITED, Limits
from ultragray.rendering.outputs import INTENSITY_SUM, WEIGHT_SUM
from ultragray.scene.deformation import displaced
from ultragray.scene.gaussians import GaussianScene

MIN_WEIGHT = 1.0 / 255.0  # the skip rule: a Gaussian is skipped where both w and α are below this
MAX_WEIGHT = 0.999
MAX_M2_ATTENUATION = 9.0  # ψ = 0 beyond three standard deviations from the ray
DEGENERATE = 1e-8
GAUSS_LEGENDRE = ((0.0, 8.0 / 9.0), (-math.sqrt(0.6), 5.0 / 9.0), (math.sqrt(0.6), 5.0 / 9.0))
ELEMENTS_PER_CHUNK = 1 << 22


class Fields(NamedTuple):
    """S = Σ w, ΣI·w and the transmittance T of one pose, each [H, W]."""

    weight_sum: Tensor
    weighted_intensity: Tensor
    transmittance: Tensor


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
    """The outputs by name, each [C, H, W] in the dtype of the scene's tensors. Raises FrameTooCostly and GivenUp."""
    if limits.footprint_pixels is not None:
        limits.check_costs(footprint_pixels(scene, probe, as_array(poses_cm), height, width, limits, beam))
    poses = torch.as_tensor(poses_cm).to(scene.means)
    views = [
        combine(_render_pose(scene, place, probe, pose, height, width, limits, beam, weighted))
        for place, pose in enumerate(poses)
    ]
    empty = scene.means.new_zeros((0, height, width))
    return {name: torch.stack([view[name] for view in views]) if views else empty for name in outputs}


def combine(fields: Fields) -> dict[str, Tensor]:
    """B = E·T, E = γ·ΣI·w/(S + 1e-8), T, γ = 1 − exp(−S), S, and ΣI·w."""
    coverage = -torch.expm1(-fields.weight_sum)
    echo = coverage * fields.weighted_intensity / (fields.weight_sum + 1e-8)
    return {
        "bmode": echo * fields.transmittance,
        "echo": echo,
        "transmittance": fields.transmittance,
        "coverage": coverage,
        WEIGHT_SUM: fields.weight_sum,
        INTENSITY_SUM: fields.weighted_intensity,
    }


def _render_pose(
    scene: GaussianScene,
    place: int,  # of the pose among those of the call
    probe: Probe,
    pose: Tensor,
    height: int,
    width: int,
    limits: Limits,
    beam: Tensor | None,
    weighted: bool,
) -> Fields:  # [H, W] each
    like = scene.means
    rotation, origin = pose[:3, :3], pose[:3, 3]
    inside, into_gaussian = scene.means, rotation  # [N, 3] in the scene; [3, 3], or [N, 3, 3] F⁻¹·rotation
    if scene.displacements:
        inside, map_at_means = displaced(inside, scene.displacements_cm(), place)
        into_gaussian = torch.linalg.solve(map_at_means, rotation.expand_as(map_at_means))
    means = (inside - origin) @ rotation  # [N, 3] probe frame
    inverse_root = inverse_root_covariance(scene, into_gaussian)  # [N, 3, 3]
    lost = None  # [N] what m² grows by: ln(|Σ'|/|Σ|) of a beam, −2·ln(weight) of a weighted Gaussian
    if beam is not None:
        inverse_root, lost = _spread_along_elevation(inverse_root, _beam_variance(beam.to(like), probe, means))
    if weighted:
        by_weight = -2.0 * torch.nn.functional.logsigmoid(scene.transmittances)
        lost = by_weight if lost is None else lost + by_weight
    intensities = intensity(scene, origin, inside)  # [N]
    tau = torch.sigmoid(scene.transmittances)  # [N]
    origins, directions = (like.new_tensor(v) for v in probe.scan_lines(width))  # [W, 3] mm, [W, 3]
    origins = origins / 10.0
    depths = like.new_tensor(probe.depths_mm(height) / 10.0)  # [H]

    weight_sum = like.new_zeros((height, width))
    weighted_intensity = like.new_zeros((height, width))
    transmittance = like.new_ones((height, width))
    x_mm, _, z_mm = 10.0 * means.detach().cpu().double().numpy().T
    (kept,) = torch.nonzero(torch.from_numpy(probe.cull(x_mm, z_mm, height)).to(like.device), as_tuple=True)
    for ids in torch.split(kept, max(1, ELEMENTS_PER_CHUNK // (9 * width))):
        rays = _intersect(means[ids], inverse_root[ids], origins, directions)  # [n, W]
        if lost is not None:
            rays = rays._replace(m2=rays.m2 + lost[ids][:, None])
        near_enough = (rays.m2 <= -2.0 * math.log(MIN_WEIGHT)).any(dim=1)  # else w and α are below 1/255
        (touching,) = torch.nonzero(near_enough, as_tuple=True)
        for part in torch.split(touching, max(1, ELEMENTS_PER_CHUNK // (height * width))):
            limits.check_flag()
            weight, alpha = _weight_and_alpha(Rays(*(r[part] for r in rays)), depths)  # [n, H, W]
            if weighted:
                alpha = torch.zeros_like(alpha)
            counted = (weight >= MIN_WEIGHT) | (alpha >= MIN_WEIGHT)
            weight = torch.where(counted, weight, 0.0)
            alpha = torch.where(counted, alpha, 0.0)
            chosen = ids[part]
            weight_sum = weight_sum + weight.sum(dim=0)
            weighted_intensity = weighted_intensity + torch.einsum("n,nhw->hw", intensities[chosen], weight)
            passed = 1.0 - alpha * (1.0 - tau[chosen])[:, None, None]
            transmittance = transmittance * passed.prod(dim=0)
    return Fields(weight_sum, weighted_intensity, transmittance)


def inverse_root_covariance(scene: GaussianScene, rotation: Tensor) -> Tensor:  # [3, 3] or [N, 3, 3] -> [N, 3, 3]
    """L with LᵀL = A = Σ⁻¹ in the probe frame: rotate into the Gaussian's own axes, divide by its scales."""
    w, x, y, z = (scene.quats / scene.quats.norm(dim=-1, keepdim=True)).unbind(-1)
    axes = torch.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ],
        dim=-1,
    ).reshape(-1, 3, 3)
    return axes.transpose(1, 2) @ rotation * torch.exp(-scene.scales)[:, :, None]


def _beam_variance(beam: Tensor, probe: Probe, means: Tensor) -> Tensor:  # [3] cm, [N, 3] -> [N] cm²
    """σ_y² at the depth of each mean along its scan line."""
    x, _, z = means.unbind(-1)
    lines = KernelLines.of(probe)
    squared = x.square() + z.square()
    depth = squared.clamp(min=torch.finfo(squared.dtype).tiny).sqrt() if lines.fanned else z * lines.axes[2, 2]
    sigma, focus, rayleigh = beam.unbind()
    return sigma.square() * (1.0 + ((depth - focus) / rayleigh).square())


def _spread_along_elevation(inverse_root: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    """L' [N, 3, 3] of Σ' = Σ + σ_y²·e eᵀ, and ln(|Σ'|/|Σ|) [N]: with n = L·e, L' = L − β·n nᵀL."""
    across = inverse_root[:, :, 1]  # n
    ratio = 1.0 + variance * across.square().sum(dim=-1)  # |Σ'|/|Σ| = 1 + σ_y²·eᵀAe
    beta = variance / (ratio.sqrt() * (1.0 + ratio.sqrt()))
    projected = torch.einsum("ni,nij->nj", across, inverse_root)
    return inverse_root - beta[:, None, None] * across[:, :, None] * projected[:, None, :], ratio.log()


class Rays(NamedTuple):
    """The crossing of a Gaussian and a scan line, each [n, W]."""

    s_star: Tensor  # depth of the largest weight, cm
    sigma: Tensor  # standard deviation along the ray, cm
    m2: Tensor  # squared Mahalanobis distance of the ray from the mean


def _intersect(means: Tensor, inverse_root: Tensor, origins: Tensor, directions: Tensor) -> Rays:
    """a = dᵀAd, s* = −b/a, m² = c − b²/a, with δ taken at the ray's point closest to the mean (no cancellation)."""
    nearest = ((means[:, None] - origins) * directions).sum(dim=-1)  # [n, W]
    delta = origins + nearest[..., None] * directions - means[:, None]  # [n, W, 3]
    along = torch.einsum("nij,wj->nwi", inverse_root, directions)
    across = torch.einsum("nij,nwj->nwi", inverse_root, delta)
    a = (along * along).sum(dim=-1)
    shift = -(along * across).sum(dim=-1) / a
    m2 = (across + shift[..., None] * along).square().sum(dim=-1)
    return Rays(s_star=nearest + shift, sigma=a.rsqrt(), m2=m2)


def _weight_and_alpha(rays: Rays, depths: Tensor) -> tuple[Tensor, Tensor]:  # [n, H, W] each
    """Echo weight w(s) and absorption α(s) before the skip rule."""
    s_star, sigma, m2 = (r[:, None, :] for r in rays)  # [n, 1, W]
    s = depths[None, :, None]  # [1, H, 1]

    def density(t: Tensor) -> Tensor:
        return torch.exp(-0.5 * m2 - 0.5 * ((t - s_star) / sigma).square())

    weight = density(s).clamp(max=MAX_WEIGHT)
    centre = torch.minimum(s_star.clamp(min=0.0), s)
    low = (centre - 3.0 * sigma).clamp(min=0.0)
    high = torch.minimum(centre + 3.0 * sigma, s)
    half, middle = (high - low) / 2.0, (high + low) / 2.0
    quadrature = half * sum(weight_q * density(middle + half * node) for node, weight_q in GAUSS_LEGENDRE)
    degenerate = (s.square() <= DEGENERATE * sigma.square()) | (high <= low)
    psi = torch.where(degenerate, s * density(s / 2.0), quadrature)
    psi = torch.where(m2 > MAX_M2_ATTENUATION, 0.0, psi)
    alpha = (-torch.expm1(-psi)).clamp(max=MAX_WEIGHT)
    return weight, alpha


def intensity(scene: GaussianScene, origin: Tensor, means: Tensor | None = None) -> Tensor:  # [3], [N, 3] cm -> [N]
    """Echo intensity I of each Gaussian seen from a probe at `origin`, by its activation (docs/physics.md §2).

    `means`: where displaced tissue has them.
    """
    offset = (scene.means if means is None else means) - origin
    length = offset.norm(dim=-1, keepdim=True)
    v = torch.where(length > 0, offset / torch.where(length > 0, length, 1.0), 0.0)
    coefficients = torch.cat([scene.sh0, scene.shN], dim=1)[..., 0]  # [N, K]
    basis = spherical_harmonics(v, scene.sh_degree)  # [N, K]
    value = (basis * coefficients).sum(dim=-1)
    if scene.info.intensity == "sigmoid":
        return torch.sigmoid(4.0 * value)
    return (value + 1.0).clamp(0.5, 0.999)


def spherical_harmonics(v: Tensor, degree: int) -> Tensor:  # [N, 3] unit -> [N, K]
    """The real basis in the order and with the signs of 3D Gaussian Splatting, K = (degree + 1)²."""
    x, y, z = v.unbind(-1)
    basis = [torch.full_like(x, 0.5 * math.sqrt(1 / math.pi))]
    if degree >= 1:
        c1 = math.sqrt(3 / (4 * math.pi))
        basis += [-c1 * y, c1 * z, -c1 * x]
    if degree >= 2:
        c2 = 0.5 * math.sqrt(15 / math.pi)
        basis += [c2 * x * y, -c2 * y * z, 0.25 * math.sqrt(5 / math.pi) * (2 * z * z - x * x - y * y)]
        basis += [-c2 * x * z, 0.5 * c2 * (x * x - y * y)]
    if degree >= 3:
        c30, c31 = 0.25 * math.sqrt(35 / (2 * math.pi)), 0.25 * math.sqrt(21 / (2 * math.pi))
        c32 = 0.5 * math.sqrt(105 / math.pi)
        basis += [-c30 * y * (3 * x * x - y * y), c32 * x * y * z, -c31 * y * (4 * z * z - x * x - y * y)]
        basis += [0.25 * math.sqrt(7 / math.pi) * z * (2 * z * z - 3 * x * x - 3 * y * y)]
        basis += [-c31 * x * (4 * z * z - x * x - y * y)]
        basis += [0.5 * c32 * z * (x * x - y * y), -c30 * x * (x * x - 3 * y * y)]
    return torch.stack(basis, dim=-1)

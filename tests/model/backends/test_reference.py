"""The reference against docs/physics.md §2 and §3 written out a second time: scalars in Python, pixel by pixel."""

import math

import numpy as np
import pytest
import torch

from ultragray import ConvexProbe, GaussianScene, LinearProbe, SceneInfo, render
from ultragray.rendering.backends.reference import spherical_harmonics
from ultragray.rendering.outputs import PLANES

LINEAR = LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=30.0)
CONVEX = ConvexProbe(opening_angle_deg=50.0, near_mm=10.0, far_mm=40.0)


def sigmoid(x):
    return 1.0 / (1.0 + math.exp(-x))


def rotation_of(quaternion):
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def harmonics(v, degree):
    """The coefficients as 3D Gaussian Splatting lists them, as numbers."""
    x, y, z = v
    values = [0.28209479177387814]
    if degree >= 1:
        values += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree >= 2:
        values += [1.0925484305920792 * x * y, -1.0925484305920792 * y * z]
        values += [0.31539156525252005 * (2 * z * z - x * x - y * y), -1.0925484305920792 * x * z]
        values += [0.5462742152960396 * (x * x - y * y)]
    if degree >= 3:
        values += [-0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z]
        values += [-0.4570457994644658 * y * (4 * z * z - x * x - y * y)]
        values += [0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y)]
        values += [-0.4570457994644658 * x * (4 * z * z - x * x - y * y)]
        values += [1.445305721320277 * z * (x * x - y * y), -0.5900435899266435 * x * (x * x - 3 * y * y)]
    return values


def pixel(
    splats,
    activation,
    probe,
    pose,  # [4, 4] mm
    index,
    size,
):
    """All outputs at one pixel, in the scene's world axes (the renderer works in the probe's)."""
    (i, j), (height, width) = index, size
    near, far = probe.near_mm / 10, probe.far_mm / 10
    rotation, position = pose[:3, :3], pose[:3, 3] / 10
    if isinstance(probe, LinearProbe):
        lateral = probe.width_mm / 10 * ((j + 0.5) / width - 0.5)
        start, heading = np.array([lateral, 0, 0]), np.array([0, 0, 1.0])
    else:
        angle = math.radians(probe.opening_angle_deg) * ((j + 0.5) / width - 0.5)
        start, heading = np.zeros(3), np.array([math.sin(angle), 0, math.cos(angle)])
    o, d = position + rotation @ start, rotation @ heading
    s = near + (far - near) * (i + 0.5) / height
    last = near + (far - near) * (height - 1) / height if height > 1 else math.inf
    weight_sum = weighted = 0.0
    transmittance = 1.0
    for n in range(len(splats["means"])):
        mean = splats["means"][n]
        inside = rotation.T @ (mean - position)
        if isinstance(probe, LinearProbe):
            depth = inside[2]
        else:
            depth = math.hypot(inside[0], inside[2]) if inside[2] > 0 else -1.0
        if not near <= depth <= last:
            continue
        axes = rotation_of(splats["quats"][n])
        precision = axes @ np.diag(np.exp(-2 * splats["scales"][n])) @ axes.T
        delta = o - mean
        a, b, c = d @ precision @ d, d @ precision @ delta, delta @ precision @ delta
        peak, sigma, m2 = -b / a, 1 / math.sqrt(a), c - b * b / a

        def density(t, m2=m2, peak=peak, sigma=sigma):
            return math.exp(-0.5 * m2) * math.exp(-0.5 * ((t - peak) / sigma) ** 2)

        weight = min(0.999, density(s))
        centre = min(max(peak, 0.0), s)
        low, high = max(centre - 3 * sigma, 0.0), min(centre + 3 * sigma, s)
        if m2 > 9:
            psi = 0.0
        elif a * s * s <= 1e-8 or high <= low:
            psi = s * density(s / 2)
        else:
            half, middle = (high - low) / 2, (high + low) / 2
            psi = half * (
                8 / 9 * density(middle)
                + 5 / 9 * density(middle - half * math.sqrt(0.6))
                + 5 / 9 * density(middle + half * math.sqrt(0.6))
            )
        alpha = min(1 - math.exp(-psi), 0.999)
        if weight < 1 / 255 and alpha < 1 / 255:
            continue
        offset = mean - position
        length = np.linalg.norm(offset)
        v = offset / length if length > 0 else offset
        degree = math.isqrt(1 + splats["shN"].shape[1]) - 1
        coefficients = [splats["sh0"][n, 0, 0], *splats["shN"][n, :, 0]]
        value = sum(y * k for y, k in zip(harmonics(v, degree), coefficients, strict=True))
        echo = sigmoid(4 * value) if activation == "sigmoid" else min(max(value + 1, 0.5), 0.999)
        weight_sum += weight
        weighted += echo * weight
        transmittance *= 1 - alpha * (1 - sigmoid(splats["transmittances"][n]))
    coverage = 1 - math.exp(-weight_sum)
    echo = coverage * weighted / (weight_sum + 1e-8)
    return {"bmode": echo * transmittance, "echo": echo, "transmittance": transmittance, "coverage": coverage}


def compare(scene, probe, poses, size):
    """Renders in float64 and compares every pixel; returns coverage [C, H, W] so that a test can ask what it saw."""
    height, width = size
    frames = render(scene.to(torch.float64), probe, poses, height=height, width=width, backend="reference")
    splats = {name: tensor.double().numpy() for name, tensor in scene.splats.items()}
    for c, pose in enumerate(poses):
        for index in np.ndindex(height, width):
            want = pixel(splats, scene.info.intensity, probe, pose, index, size)
            got = {name: float(getattr(frames, name)[(c, *index)]) for name in PLANES}
            assert got == pytest.approx(want, abs=1e-9), (c, index)
    return frames.coverage.numpy()


def one_gaussian(
    mean_cm,
    sigma_cm=(0.2, 0.2, 0.2),
    quaternion=(1.0, 0.0, 0.0, 0.0),
    transmittance_logit=0.0,
    sh=(0.5,),
    intensity="released",
):
    splats = {
        "means": torch.tensor([mean_cm], dtype=torch.float64),
        "scales": torch.tensor([sigma_cm], dtype=torch.float64).log(),
        "quats": torch.tensor([quaternion], dtype=torch.float64),
        "transmittances": torch.tensor([transmittance_logit], dtype=torch.float64),
        "sh0": torch.tensor(sh[:1], dtype=torch.float64).reshape(1, 1, 1),
        "shN": torch.tensor(sh[1:], dtype=torch.float64).reshape(1, -1, 1),
    }
    return GaussianScene.from_splats(splats, info=SceneInfo(intensity=intensity))


HERE = np.eye(4)[None]


@pytest.mark.parametrize("probe", [LINEAR, CONVEX], ids=["linear", "convex"])
@pytest.mark.parametrize(
    ("mean_cm", "sigma_cm"),
    [
        ((0.1, 0.05, 1.7), (0.2, 0.2, 0.2)),
        ((0.1, 0.3, 1.7), (0.3, 0.1, 0.2)),  # three sigma off the plane: m² near 9
        ((0.0, 0.05, 1.01), (0.3, 0.2, 0.5)),  # the integral is clipped at depth 0
        ((0.3, 0.0, 2.5), (2.0, 1.0, 3.0)),  # larger than the image
        ((0.02, 0.0, 1.5), (0.01, 0.02, 0.01)),  # smaller than a pixel
        ((0.0, 0.0, 1.5), (0.9, 0.4, 0.02)),  # a plate across the beam
    ],
)
def test_one_gaussian(probe, mean_cm, sigma_cm):
    scene = one_gaussian(mean_cm, sigma_cm, quaternion=(0.9, 0.1, -0.2, 0.3))
    compare(scene, probe, HERE, (15, 11))


def test_the_worked_value_in_the_middle_of_a_gaussian():
    """At its centre w = S = 0.999 (clamped), and a fully crossed one has ψ = 1.153·√(2π)·σ (docs/physics.md §3)."""
    scene = one_gaussian((0.0, 0.0, 1.5), (0.1, 0.1, 0.1), transmittance_logit=0.0, sh=(0.0,))
    probe = LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=30.0)
    frames = render(scene, probe, HERE, height=3, width=1, backend="reference")
    values = {name: getattr(frames, name)[0, :, 0] for name in PLANES}  # rows at 0.5, 1.5, 2.5 cm
    assert values["coverage"][1].item() == pytest.approx(1 - math.exp(-0.999), abs=1e-12)
    assert values["echo"][1].item() == pytest.approx((1 - math.exp(-0.999)) * 0.999, abs=1e-7)
    alpha = 1 - math.exp(-1.153 * math.sqrt(2 * math.pi) * 0.1)
    assert values["transmittance"][2].item() == pytest.approx(1 - alpha / 2, abs=2e-4)
    assert values["transmittance"][0].item() == 1.0
    product = (values["echo"] * values["transmittance"])[1].item()
    assert values["bmode"][1].item() == pytest.approx(product, abs=1e-12)


def test_the_skip_rule_needs_both_below_a_255th():
    """Behind a strong Gaussian its own tail counts under 1/255 too; behind a faint one it does not."""
    probe = LinearProbe(width_mm=2.0, near_mm=0.0, far_mm=30.0)
    tails = []
    for offset_cm in (0.0, 0.32):  # m² = 0 and 10.24: no attenuation
        scene = one_gaussian((0.0, offset_cm, 1.0), (0.1, 0.1, 0.1))
        coverage = compare(scene, probe, HERE, (100, 1))[0, :, 0]
        tails.append(coverage[(coverage > 0) & (coverage < 1 / 256)])
    assert len(tails[0]) > 3
    assert len(tails[1]) == 0


def test_a_ray_far_shorter_than_the_gaussian_is_degenerate():
    scene = one_gaussian((0.0, 0.0, 2e-4), (50.0, 50.0, 50.0))
    probe = LinearProbe(width_mm=1.0, near_mm=0.0, far_mm=0.06)
    compare(scene, probe, HERE, (4, 2))  # a·s² from 1e-10 to 1e-8


@pytest.mark.parametrize("intensity", ["released", "sigmoid"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_random_scenes_of_each_degree(random_scene, random_poses, degree, intensity):
    scene = random_scene(
        12,
        sh_degree=degree,
        intensity=intensity,
        extent_cm=(1, 0.4, 2),
        centre_cm=(0, 0, 1.5),
        sigma_cm=(0.1, 0.4),
        seed=degree,
    )
    poses = random_poses(2, seed=degree)
    poses[1, :3, :3] = rotation_of(np.array([0.1, 0.9, 0.3, -0.2]))  # looks elsewhere: other harmonics
    poses[1, :3, 3] = -poses[1, :3, :3] @ (0, 0, 15) + (0, 0, 15)
    for probe in (LINEAR, CONVEX):
        assert (compare(scene, probe, poses, (7, 9)) > 0.05).mean() > 0.1


def test_the_intensity_is_clamped_at_both_ends():
    echoes = []
    for coefficient in (-9.0, -0.5, 9.0):
        scene = one_gaussian((0.0, 0.0, 1.5), (5.0, 5.0, 5.0), sh=(coefficient,))
        frames = render(scene, LINEAR, HERE, height=3, width=1, outputs=("echo", "coverage"), backend="reference")
        assert frames.coverage is not None
        echoes.append((frames.echo / frames.coverage)[0, 1, 0].item())
    assert echoes == pytest.approx([0.5, 1 - 0.5 * 0.28209479, 0.999], abs=1e-7)


def test_harmonics_are_orthonormal():
    """∫ Y_a Y_b over the sphere is 1 for a = b and 0 else, by a product rule exact to degree 6."""
    z, weights = np.polynomial.legendre.leggauss(8)
    phi = 2 * np.pi * np.arange(16) / 16
    ring = np.sqrt(1 - z**2)
    points = np.stack([np.outer(ring, np.cos(phi)), np.outer(ring, np.sin(phi)), np.outer(z, np.ones(16))], -1).reshape(
        -1, 3
    )
    basis = spherical_harmonics(torch.from_numpy(points), 3).numpy()
    gram = (basis * np.repeat(weights * 2 * np.pi / 16, 16)[:, None]).T @ basis
    np.testing.assert_allclose(gram, np.eye(16), atol=1e-12)
    np.testing.assert_allclose(basis, [harmonics(v, 3) for v in points], atol=1e-9)


def test_a_gaussian_at_the_probe_has_no_direction():
    scene = one_gaussian((0.0, 0.0, 0.0), sh=(0.1, 5.0, 5.0, 5.0))
    frames = render(scene, LINEAR, HERE, height=5, width=3, backend="reference")
    assert all(torch.isfinite(getattr(frames, name)).all() for name in PLANES)
    compare(scene, LINEAR, HERE, (5, 3))


@pytest.mark.parametrize(
    ("mean_cm", "visible"),
    [
        ((0.0, 0.0, 1.05), True),
        ((0.0, 0.0, 0.95), False),
        ((1.5, 0.0, 2.0), True),  # range 2.5: beyond by range only if culled by z alone
        ((0.55, 0.0, 0.9), True),  # z is before the face, range 1.055 is not
        ((0.0, 2.0, 0.9), False),  # elevation does not count as range
        ((0.0, 0.0, -2.0), False),  # behind the apex
        ((1.5, 0.0, 3.6), False),  # range 3.9 > 3.7, the top of the last of ten rows; z is not
    ],
)
def test_a_convex_probe_culls_by_range_in_the_plane(mean_cm, visible):
    scene = one_gaussian(mean_cm, (3.0, 3.0, 3.0))
    assert compare(scene, CONVEX, HERE, (10, 5)).any() == visible

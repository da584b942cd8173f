"""Every backend and instruction set renders what the reference does in float64, and the released implementation."""

import math

import numpy as np
import pytest
import torch

from ultragray import (
    ConvexProbe,
    ElevationBeam,
    Frames,
    GaussianScene,
    LinearProbe,
    PhasedProbe,
    Probe,
    render,
)
from ultragray.errors import BackendUnavailable, InvalidArgument
from ultragray.rendering.backends import cuda
from ultragray.rendering.frames import footprint_pixels
from ultragray.rendering.outputs import PLANES, WEIGHT_SUM

from .conftest import CASES, FOCUSED, KERNELS, LINEAR, PHASED, drawn


@pytest.fixture(scope="session")
def prepared(random_scene, random_poses):
    """By case: the scene, its poses, the reference in float64, and where float32 agrees with it."""
    done = {}

    def prepare(name):
        if name not in done:
            case = CASES[name]
            scene = random_scene(**{"seed": 7, **case.scene})
            poses = random_poses(case.poses, seed=11, tilt_deg=case.tilt_deg)
            exact, single = (
                drawn("reference", scene.to(dtype), case.probe, poses, case.beam, size=(case.height, case.width))
                for dtype in (torch.float64, torch.float32)
            )
            expected = {output: plane.numpy() for output, plane in exact.items()}
            stable = np.all([np.abs(single[output].numpy() - expected[output]) < 2e-5 for output in PLANES], axis=0)
            done[name] = (case, scene, poses, expected, stable)
        return done[name]

    return prepare


def test_every_kind_of_probe_is_tested():
    assert {case.probe.kind for case in CASES.values()} == set(Probe.members)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", CASES)
def test_matches_the_reference_in_float64(name, kernel, prepared, assert_agrees):
    case, scene, poses, expected, stable = prepared(name)
    if kernel == "cuda" and cuda.interpreted():  # slow
        poses, stable = poses[:2], stable[:2]
        expected = {output: plane[:2] for output, plane in expected.items()}
    assert stable.mean() > 0.995
    assert (expected["coverage"] > 0.01).mean() > 0.002, "the case shows too little to test anything"
    frames = Frames(drawn(kernel, scene, case.probe, poses, case.beam, size=(case.height, case.width)))
    assert frames.bmode.dtype == torch.float32
    assert_agrees(frames, expected, tolerance=5e-4, stable=stable)


@pytest.fixture(params=["reference", *KERNELS])
def planes(request):
    """The outputs of a kernel, [4, C, H, W]."""

    def draw(scene, probe, poses, height=20, width=30):
        found = drawn(request.param, scene, probe, poses, size=(height, width))
        return np.stack([found[name].cpu().numpy() for name in PLANES])

    return draw


def test_no_poses_give_no_frames(planes, random_scene):
    frames = planes(random_scene(5), LINEAR, np.zeros((0, 4, 4)), np.int64(9), np.int64(7))
    assert frames.shape == (4, 0, 9, 7)


@pytest.mark.parametrize("offset_mm", [(0, 500, 0), (500, 0, 0), (0, 0, 500), (0, 0, -500)])
def test_a_scene_out_of_view_is_black(planes, random_scene, offset_mm):
    pose = np.eye(4)
    pose[:3, 3] = offset_mm
    bmode, _, transmittance, coverage = planes(random_scene(50), LINEAR, pose[None])
    assert not bmode.any()
    assert not coverage.any()
    assert (transmittance == 1).all()


def test_a_batch_is_its_frames_one_by_one(planes, random_scene, random_poses):
    scene, poses = random_scene(120), random_poses(7)
    batch = planes(scene, LINEAR, poses, 33, 41)
    for c, pose in enumerate(poses):
        alone = planes(scene, LINEAR, pose[None], 33, 41)
        np.testing.assert_allclose(batch[:, c], alone[:, 0], atol=1e-6)


def test_strided_tensors_are_read_as_they_are(planes, random_scene, random_poses):
    dense, poses = random_scene(60, sh_degree=2), random_poses(2)
    strided = GaussianScene.from_splats(
        {name: torch.stack([t, t + 9.0], dim=-1)[..., 0] for name, t in dense.splats.items()}
    )
    assert not strided.means.is_contiguous()
    np.testing.assert_array_equal(planes(strided, LINEAR, poses), planes(dense, LINEAR, poses))


def test_a_changed_scene_renders_anew(planes, random_scene):
    scene, poses = random_scene(60), np.eye(4)[None]
    before = planes(scene, LINEAR, poses)
    scene.means.add_(torch.tensor([0.5, 0.0, 0.0]))
    after = planes(scene, LINEAR, poses)
    fresh = GaussianScene.from_splats({name: t.clone() for name, t in scene.splats.items()})
    assert np.abs(after - before).max() > 0.05
    np.testing.assert_array_equal(after, planes(fresh, LINEAR, poses))


def test_the_centre_moves_the_frame_of_the_poses(planes, random_scene, random_poses):
    centre = np.array([123.0, -45.0, 67.0])
    poses = random_poses(2)
    moved = poses.copy()
    moved[:, :3, 3] += centre
    here = planes(random_scene(60), LINEAR, poses)
    there = planes(random_scene(60, info={"centre_mm": tuple(centre)}), LINEAR, moved)
    np.testing.assert_allclose(there, here, atol=2e-5)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("transmittances", 60.0),
        ("transmittances", -60.0),
        ("quats", 1e4),
        ("quats", 1e-4),
        ("sh0", 50.0),
        ("sh0", -50.0),
    ],
)
def test_extreme_parameters_stay_exact(kernel, random_scene, random_poses, assert_agrees, name, value):
    scene, poses = random_scene(80, seed=3), random_poses(4, seed=3)
    tensor = scene.splats[name]
    tensor.copy_(tensor * value if name == "quats" else torch.full_like(tensor, value))
    exact = drawn("reference", scene.to(torch.float64), LINEAR, poses)
    assert_agrees(Frames(drawn(kernel, scene, LINEAR, poses)), exact, tolerance=5e-4)


@pytest.mark.parametrize(
    ("probe", "depth_cm", "visible"),
    [
        (LinearProbe(40, 10, 50), 0.999, False),
        (LinearProbe(40, 10, 50), 1.001, True),
        (LinearProbe(40, 10, 50), 4.599, True),  # the last of 10 rows starts at 46 mm
        (LinearProbe(40, 10, 50), 4.601, False),
        (ConvexProbe(opening_angle_deg=60, near_mm=10, far_mm=50), 4.599, True),
        (ConvexProbe(opening_angle_deg=60, near_mm=10, far_mm=50), 4.601, False),
        (PhasedProbe(opening_angle_deg=60, far_mm=50), 0.001, True),
        (PhasedProbe(opening_angle_deg=60, far_mm=50), -0.001, False),
    ],
)
def test_the_depth_cull_is_by_the_mean(planes, probe, depth_cm, visible):
    scene = GaussianScene.from_splats(
        {
            "means": torch.tensor([[0.0, 0.0, depth_cm]]),
            "scales": torch.full((1, 3), -1.0),
            "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
            "transmittances": torch.zeros(1),
            "sh0": torch.zeros(1, 1, 1),
        }
    )
    coverage = planes(scene, probe, np.eye(4)[None], 10, 11)[3]
    assert coverage.any() == visible


def test_a_phased_probe_sees_what_a_convex_one_without_a_radius_sees(planes, random_scene, random_poses):
    convex = ConvexProbe(opening_angle_deg=90.0, near_mm=0.0, far_mm=60.0)
    phased_frames, convex_frames = (
        planes(random_scene(120), probe, random_poses(3), 33, 41) for probe in (PHASED, convex)
    )
    np.testing.assert_array_equal(phased_frames, convex_frames)


def test_an_unknown_backend_is_named(random_scene):
    with pytest.raises(BackendUnavailable, match="auto, reference, cpu, cuda, got 'gpu'"):
        render(random_scene(1), LINEAR, np.eye(4), height=4, width=4, backend="gpu")


def single(mean, scales, copies=1, **splats):
    """Equal Gaussians at `mean` (cm) with raw `scales` (log cm), opaque black unless `splats` says otherwise."""
    raw = {
        "means": torch.tensor([mean] * copies, dtype=torch.float32),
        "scales": torch.tensor([scales] * copies, dtype=torch.float32),
        "quats": torch.tensor([[1.0, 0.3, -0.2, 0.5]] * copies),
        "transmittances": torch.full((copies,), -30.0),
        "sh0": torch.zeros(copies, 1, 1),
    }
    return GaussianScene.from_splats({**raw, **splats})


EXTREMES = {
    "a sheet without thickness": single((0, 0, 2), (-1, -1, -20)),
    "a needle without thickness": single((0, 0, 2), (-1, -20, -20)),
    "a point": single((0, 0, 2), (-20, -20, -20)),
    "as wide as may be": single((0, 0, 2), (20, 20, 20)),
    "a quaternion near zero": single((0, 0, 2), (-1, -2, -3), quats=torch.tensor([[3e-6, 6e-7, 0, 9e-7]])),
    "one at the probe's origin": single((0, 0, 0), (-1, -1, -1)),
    "many in one place": single((0, 0, 1), (-1.2, -1.2, -1.2), copies=30, transmittances=torch.zeros(30)),
    "absorbing above the rows where it echoes": single(
        (0, 0.88, 4), (math.log(0.3), math.log(0.3), math.log(10)), quats=torch.tensor([[1.0, 0, 0, 0]])
    ),
}


@pytest.mark.parametrize("kernel", KERNELS)  # beyond the reference's own float32
@pytest.mark.parametrize("name", EXTREMES)
def test_extreme_gaussians(name, kernel, assert_agrees):
    view = LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=80.0), np.eye(4)[None]
    exact = drawn("reference", EXTREMES[name].to(torch.float64), *view, size=(40, 40))
    assert_agrees(Frames(drawn(kernel, EXTREMES[name], *view, size=(40, 40))), exact, tolerance=5e-4)


# Of the released implementation, in ../shared/golden. Scenes of thousands of Gaussians take the reference a minute:
# `make test` draws these with the CPU kernel alone, which the cases above hold to the reference.
GOLDEN = [
    pytest.param(
        name,
        backend,
        id=f"{backend}-{name}",
        marks=[pytest.mark.long] * (backend == "reference" and name in ("g05", "g06", "g08")),
    )
    for name in ("g01", "g03", "g05", "g06", "g08")
    for backend in ("reference", "cpu", "cuda")
]


@pytest.mark.parametrize(("name", "backend"), GOLDEN)
def test_all_outputs_match(golden, assert_agrees, on_device, name, backend):
    file, is_exact = golden(name), backend == "reference"
    scene = file.scene(torch.float64 if is_exact else torch.float32)
    scene = on_device(scene) if backend == "cuda" else scene
    frames = render(scene, file.probe, file.poses, height=file.height, width=file.width, backend=backend)
    assert frames.bmode.dtype == scene.means.dtype
    assert_agrees(frames, file.expected, tolerance=5e-5 if is_exact else 5e-4, stable=file.stable)


CONSTANT = ElevationBeam(thickness_mm=3.0)


def shifted_along_elevation(pose, shift_mm):  # [4, 4], [K] -> [K, 4, 4]
    poses = np.repeat(pose[None], len(shift_mm), axis=0)
    poses[:, :3, 3] += shift_mm[:, None] * pose[:3, 1]
    return poses


def weight_sums(scene, poses, beam):  # [C, H, W]
    return drawn("reference", scene, LINEAR, poses, beam, outputs=(WEIGHT_SUM,))[WEIGHT_SUM]


def test_a_constant_beam_is_the_mean_of_thin_slices(random_scene, random_poses):
    scene = random_scene(4, seed=1, sigma_cm=(0.2, 0.6), dtype=torch.float64)
    (pose,) = random_poses(1, seed=2)
    nodes, weights = np.polynomial.hermite_e.hermegauss(31)
    sigma_mm = CONSTANT.thickness_mm / 2.3548
    slices = weight_sums(scene, shifted_along_elevation(pose, nodes * sigma_mm), None)
    mean = torch.einsum("k,khw->hw", torch.from_numpy(weights / weights.sum()), slices)
    thick = weight_sums(scene, pose[None], CONSTANT)[0]
    assert thick.max() > 0.2
    assert (thick - mean).abs().max() < 4 / 255  # of each Gaussian, weights below 1/255 may be left out


def test_a_beam_conserves_the_weight_that_lies_across_elevation(random_scene):
    scene = random_scene(4, seed=1, sigma_cm=(0.1, 0.3), dtype=torch.float64)
    across = np.linspace(-25.0, 25.0, 101)
    poses = shifted_along_elevation(np.eye(4), across)
    thin, thick = (weight_sums(scene, poses, beam).sum() for beam in (None, ElevationBeam(thickness_mm=4.0)))
    assert thick == pytest.approx(float(thin), rel=0.1)


def test_a_thickness_grows_by_the_square_root_of_two_within_half_the_depth_of_field():
    for offset in (-6.0, 6.0):
        assert FOCUSED.thickness_at_mm(15.0 + offset) == pytest.approx(2.0 * np.sqrt(2.0))
    assert CONSTANT.thickness_at_mm(40.0) == 3.0


def test_the_beam_of_the_scene_holds_unless_another_is_asked_for(random_scene):
    scene, thick = random_scene(100), random_scene(100, info={"beam": CONSTANT})

    def frame(scene, beam=None):
        return render(scene, LINEAR, np.eye(4), height=32, width=32, beam=beam).bmode

    assert torch.equal(frame(thick), frame(scene, CONSTANT))
    assert not torch.equal(frame(thick), frame(scene))
    assert torch.equal(frame(thick, ElevationBeam(thickness_mm=0.0)), frame(scene))


def test_a_thick_slice_cuts_more_gaussians_and_costs_more(random_scene):
    scene = random_scene(2000, sigma_cm=(0.02, 0.05))
    thin, thick = (
        footprint_pixels(scene, LINEAR, np.eye(4), height=64, width=64, beam=beam)[0] for beam in (None, CONSTANT)
    )
    assert thick > 2 * thin


def test_a_beam_of_another_shape_is_refused(random_scene):
    with pytest.raises(InvalidArgument, match=r"an ElevationBeam or a tensor \[3\]"):
        render(random_scene(2), LINEAR, np.eye(4), height=8, width=8, beam=torch.ones(2))

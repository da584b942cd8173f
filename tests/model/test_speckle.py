"""Natural speckle: fixed in the tissue, the same for a pose every time, alike on every backend, fitted to a sweep."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import ConvexProbe, GaussianScene, LinearProbe, RadialProbe, SceneInfo, render
from ultragray.contract import to_dict
from ultragray.errors import InvalidArgument
from ultragray.geometry.rotations import rotations_of
from ultragray.learn.evaluation.scoring import evaluate
from ultragray.learn.evaluation.speckle import compare_speckle, summarize
from ultragray.learn.sweep import Sweep
from ultragray.learn.training.speckle import fit_speckle
from ultragray.rendering.backends.cpu import INSTRUCTION_SETS
from ultragray.rendering.frames import render_shown
from ultragray.rendering.settings import Encoding, FrameSettings, Speckle
from ultragray.rendering.speckle import Compression, added, kernel_speckle, speckle
from ultragray.scene.info import info_from_json, info_to_json
from ultragray.scene.speckle import BANDS, LEVELS, SpeckleModel

AXES = np.eye(3)
LINEAR = LinearProbe(width_mm=32.0, near_mm=0.0, far_mm=32.0)
FAN = ConvexProbe(opening_angle_deg=50.0, near_mm=20.0, far_mm=60.0)
ALL_ROUND = RadialProbe(near_mm=5.0, far_mm=25.0)
SIDE = 128
MODEL = SpeckleModel(
    seed=7,
    axial_mm=(0.4,) * BANDS,
    lateral_mm=(0.5, 0.6, 0.7, 0.8),
    elevation_mm=(0.8,) * BANDS,
    cell_mm=(1.0, 1.07, 0.8),
    strength=(0.02, *(0.08,) * (LEVELS - 1)),
    wavenumber_per_mm=20.0,
    looks=1.6,
    floor=0.05,
)


def pose_at(x=0.0, y=0.0, z=0.0, turn=(0.0, 0.0, 0.0)):  # mm, rad
    pose = np.eye(4)
    pose[:3, :3] = rotations_of(np.array([turn]))[0]
    pose[:3, 3] = x, y, z
    return pose


def drawn(*poses, model=MODEL, probe=LINEAR):
    frames = torch.zeros(len(poses), SIDE, SIDE)
    return kernel_speckle(model, AXES, probe, np.stack(poses), frames, alone=True).numpy()


def likeness(one, other):
    return float(np.corrcoef(one.ravel(), other.ravel())[0, 1])


def test_speckle_has_mean_0_and_deviation_1():
    for model in (MODEL, replace(MODEL, looks=2.0, floor=1.0), replace(MODEL, looks=1.0, floor=0.0)):
        frames = drawn(*(pose_at(y=10.0 * number) for number in range(8)), model=model)
        assert abs(frames.mean()) < 0.06
        assert abs(frames.std() - 1.0) < 0.05
        assert abs((frames**3).mean() - Compression.of(model.looks, model.floor).skewness) < 0.25


@pytest.mark.parametrize("probe", [LINEAR, FAN, ALL_ROUND], ids=lambda one: one.kind)
@pytest.mark.parametrize("instruction_set", INSTRUCTION_SETS)
def test_the_kernel_draws_what_the_definition_says(probe, instruction_set):
    poses = np.stack([pose_at(1.0, 2.0, 3.0, (0.1, 0.05, -0.2)), pose_at(1e5, -3e4, 7e4)])
    bmode = torch.rand(2, 40, 37, generator=torch.Generator().manual_seed(0))
    expected = added(MODEL, bmode, torch.from_numpy(speckle(MODEL, AXES, probe, poses, (40, 37))).float())
    found = kernel_speckle(MODEL, AXES, probe, poses, bmode, instruction_set=instruction_set)
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_a_pose_has_the_same_bytes_in_any_batch_on_any_number_of_threads():
    poses = [pose_at(0.1 * number, 0.2 * number, turn=(0.0, 0.01 * number, 0.0)) for number in range(5)]
    together = drawn(*poses)
    threads = torch.get_num_threads()
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            for pose, frame in zip(poses, together, strict=True):
                np.testing.assert_array_equal(drawn(pose)[0], frame)
    finally:
        torch.set_num_threads(threads)


@pytest.mark.parametrize("axis", [0, 2], ids=["lateral", "axial"])
def test_speckle_stays_with_the_tissue(axis):
    pixels, model = 5, replace(MODEL, lateral_mm=(0.5,) * BANDS)
    shift = [0.0, 0.0, 0.0]
    shift[axis] = pixels * 32.0 / SIDE
    before, after = drawn(pose_at(), pose_at(*shift), model=model)
    if axis == 0:
        moved, kept = after[:, :-pixels], before[:, pixels:]
    else:
        moved, kept = after[:-pixels], before[pixels:]
    assert likeness(moved, kept) > 0.8
    assert likeness(after, before) < 0.5


def test_speckle_changes_with_elevation_as_far_as_the_slice_is_thick():
    frames = drawn(*(pose_at(y=0.8 * sigmas) for sigmas in (0.0, 0.25, 1.0, 3.0)))
    assert likeness(frames[0], frames[1]) > 0.9
    assert 0.4 < likeness(frames[0], frames[2]) < 0.7  # e^-1/2 = 0.61
    assert likeness(frames[0], frames[3]) < 0.1


def test_speckle_changes_with_the_angle_as_the_carrier_says():
    tilted = pose_at(turn=(np.radians(2.0), 0.0, 0.0))
    with_carrier, without = (
        likeness(*drawn(pose_at(), tilted, model=replace(MODEL, wavenumber_per_mm=one))[:, : SIDE // 8])
        for one in (20.0, 0.0)
    )
    assert without > 0.9
    assert with_carrier < 0.85


def test_another_seed_is_other_speckle():
    assert abs(likeness(drawn(pose_at()), drawn(pose_at(), model=replace(MODEL, seed=8)))) < 0.1


def test_no_part_of_a_frame_comes_again():
    frame = drawn(pose_at())[0].astype(np.float64)
    spectrum = np.abs(np.fft.fft2(frame - frame.mean())) ** 2
    correlation = np.fft.ifft2(spectrum).real / spectrum.mean()
    near = np.minimum(np.arange(SIDE), SIDE - np.arange(SIDE))
    correlation[(near[:, None] < 12) & (near < 12)] = 0.0
    assert correlation.max() < 0.15


@pytest.fixture
def scene(random_scene):
    made = random_scene(info={"probe": LINEAR, "speckle": MODEL})
    made.training_poses = np.stack([pose_at(y=0.5 * number) for number in range(6)])
    return made


SIZE = {"height": 48, "width": 40}
POSES = np.stack([pose_at(0.3, 0.2, 0.1), pose_at(0.0, 1.0, 0.0, (0.02, 0.0, 0.05))])


def test_bmode_has_speckle_and_nothing_else_has(scene):
    outputs = ("bmode", "echo", "transmittance", "coverage")
    plain = render(scene, None, POSES, **SIZE, outputs=outputs)
    shown = render(scene, None, POSES, **SIZE, outputs=outputs, speckle="natural")
    assert (shown["bmode"] - plain["bmode"]).std() > 0.01
    assert 0.0 <= shown["bmode"].min() <= shown["bmode"].max() <= 1.0
    for name in outputs[1:]:
        assert torch.equal(shown[name], plain[name])


def test_backends_draw_the_same_speckle(scene):
    cpu, reference = (
        render(scene, None, POSES, **SIZE, outputs=("bmode",), speckle="natural", backend=backend)["bmode"]
        for backend in ("cpu", "reference")
    )
    np.testing.assert_allclose(cpu, reference, atol=2e-4)


def test_the_gradient_is_that_without_speckle(scene):
    gradients = []
    for chosen in Speckle:
        scene.sh0.requires_grad_().grad = None
        render(scene, None, POSES, **SIZE, outputs=("bmode",), speckle=chosen)["bmode"].sum().backward()
        gradients.append(scene.sh0.grad)
    assert torch.equal(*gradients)


def test_scan_lines_off_the_skin_stay_dark(scene):
    lifted = pose_at(z=-30.0)
    frames = render(scene, None, lifted, **SIZE, outputs=("bmode",), speckle="natural", contact="air")
    assert not frames.touch.lines.any()
    assert frames["bmode"].max() == 0.0


def test_a_scene_that_does_not_know_its_speckle_refuses_it(random_scene):
    plain = random_scene(info={"probe": LINEAR})
    words = "speckle natural needs a scene whose training fitted the speckle"
    with pytest.raises(InvalidArgument, match=words):
        render(plain, None, POSES, **SIZE, speckle="natural")
    with pytest.raises(InvalidArgument, match=words):
        FrameSettings(speckle=Speckle.NATURAL).resolved(plain.info, Encoding.UINT8)
    with pytest.raises(InvalidArgument, match="speckle must be one of off, natural, got 'loud'"):
        render(plain, None, POSES, **SIZE, speckle="loud")


def test_settings_ask_for_it(scene):
    settings = FrameSettings(**SIZE, speckle=Speckle.NATURAL).resolved(scene.info, Encoding.FLOAT32)
    expected = render(scene, None, POSES, **SIZE, outputs=("bmode",), beam=settings.beam, speckle="natural")
    assert torch.equal(render_shown(scene, settings, POSES)["bmode"], expected["bmode"])


def test_scene_files_keep_the_model_and_files_without_one_are_as_before(scene, tmp_path):
    scene.save(tmp_path / "with.ugr")
    assert GaussianScene.load(tmp_path / "with.ugr").info.speckle == MODEL
    assert "speckle" not in info_to_json(SceneInfo())
    assert info_from_json(info_to_json(SceneInfo())).speckle is None


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"axial_mm": [0.4]}, "axial_mm must be 4 numbers, got 1"),
        ({"strength": [2.0] * LEVELS}, "strength"),
        ({"cell_mm": [0.0, 1.0, 1.0]}, "cell_mm"),
        ({"floor": "loud"}, "floor"),
    ],
)
def test_a_model_that_is_none_is_refused(changed, words):
    document = '{"format_version": 1, "speckle": %s}'
    with pytest.raises(ValueError, match=words):
        info_from_json(document % str(to_dict(MODEL) | changed).replace("'", '"'))


def grey_scene():
    """One Gaussian, so large that frames of it are grey all over."""
    tensors = {
        "means": torch.zeros(1, 3),
        "scales": torch.full((1, 3), 5.0),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "transmittances": torch.full((1,), 12.0),
        "sh0": torch.full((1, 1, 1), 0.0),
        "shN": torch.zeros(1, 0, 1),
    }
    return GaussianScene.from_splats(tensors, info=SceneInfo(probe=LINEAR, intensity="sigmoid", centre_mm=(0, 0, 16)))


def test_the_fit_finds_the_speckle_of_a_sweep():
    model = replace(MODEL, lateral_mm=(0.6,) * BANDS, wavenumber_per_mm=0.0, looks=2.0, floor=0.3)
    poses = [pose_at(y=0.15 * number, x=0.05 * (number % 3)) for number in range(40)]
    poses = np.stack(poses)
    scene = grey_scene()
    grey = render(scene, None, poses, height=SIDE, width=SIDE, outputs=("bmode",))["bmode"]
    assert grey.std() < 0.01
    images = (kernel_speckle(model, AXES, LINEAR, poses, grey).numpy() * 255.0).round().astype(np.uint8)
    sweep = Sweep(images, poses, LINEAR, np.arange(len(poses)), "speckled")
    found = fit_speckle(scene, sweep, backend="cpu")
    np.testing.assert_allclose(found.axial_mm, model.axial_mm, rtol=0.15)
    np.testing.assert_allclose(found.lateral_mm, model.lateral_mm, rtol=0.2)
    np.testing.assert_allclose(found.elevation_mm, model.elevation_mm, rtol=0.35)
    np.testing.assert_allclose(np.interp(float(grey.mean()), np.linspace(0, 1, LEVELS), found.strength), 0.08, rtol=0.1)
    skewness = [Compression.of(one.looks, one.floor).skewness for one in (model, found)]
    assert abs(skewness[0] - skewness[1]) < 0.2
    drawn_again = kernel_speckle(replace(found, seed=1), AXES, LINEAR, poses, grey).numpy()
    summary = summarize(compare_speckle(drawn_again, images.astype(np.float32) / 255.0, LINEAR))
    for name, value in to_dict(summary.true).items():
        assert abs(to_dict(summary.rendered)[name] / value - 1.0) < 0.1, name


def test_metrics_are_without_speckle_and_its_statistics_are_told_beside(scene):
    poses = np.stack([pose_at(y=0.5 * number) for number in range(3)])
    images = render(scene, None, poses, **SIZE, outputs=("bmode",), speckle="natural")["bmode"]
    sweep = Sweep((images * 255.0).round().byte().numpy(), poses, LINEAR, np.arange(3), "speckled")
    found = evaluate(scene, sweep)
    scene.info = replace(scene.info, speckle=None)
    without = evaluate(scene, sweep)
    assert found.frames == without.frames
    assert found.speckle == without.speckle
    assert found.natural.histogram_distance < 0.2 * found.speckle.histogram_distance
    assert found.to_dict()["natural"] == found.natural.to_dict()
    assert without.natural is None
    assert "natural" not in without.to_dict()


def test_frames_without_texture_have_no_speckle_to_find():
    scene, poses = grey_scene(), np.stack([pose_at(y=0.5 * number) for number in range(12)])
    images = np.full((len(poses), SIDE, SIDE), 127, np.uint8)
    images[:, 0, 0] = 128  # a frame may not be constant
    sweep = Sweep(images, poses, LINEAR, np.arange(len(poses)), "smooth")
    assert fit_speckle(scene, sweep, backend="cpu") is None


def test_frames_too_far_apart_to_share_speckle_tell_that_within_a_frame_alone():
    poses = np.stack([pose_at(y=20.0 * number) for number in range(6)])
    scene = grey_scene()
    grey = render(scene, None, poses, height=SIDE, width=SIDE, outputs=("bmode",))["bmode"]
    images = (kernel_speckle(MODEL, AXES, LINEAR, poses, grey).numpy() * 255.0).round().astype(np.uint8)
    sweep = Sweep(images, poses, LINEAR, np.arange(len(poses)), "sparse")
    found = fit_speckle(scene, sweep, backend="cpu")
    assert found is not None
    np.testing.assert_allclose(found.axial_mm, MODEL.axial_mm, rtol=0.3)

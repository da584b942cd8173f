"""`ultragray render`: real files in, real files out; a mistake gives one line and exit code 2."""

import json
from dataclasses import fields, replace

import cv2
import h5py
import numpy as np
import pytest
import torch

import ultragray
from ultragray import GaussianScene, LinearProbe, render
from ultragray.contract import from_dict, to_dict
from ultragray.datasets.plus import read_plus_sweep
from ultragray.files import file_sha256
from ultragray.rendering.backends import cpu
from ultragray.rendering.display import Display
from ultragray.rendering.frames import show
from ultragray.rendering.settings import SettingsUsed
from ultragray.rendering.tools import Needle, ToolFrame
from ultragray.samplers import FanSampler
from ultragray.scene.confidence import FIGURES, Assessor, ConfidenceModel, figure_arrays

from .command_line import refused, run, succeeded

LINEAR = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)


ORIGIN = ("scene", "scene_sha256", "renderer", "probe", "slice_thickness_mm", "display", "picture")
CONVEX_JSON = '{"kind": "convex", "opening_angle_deg": 60, "near_mm": 10, "far_mm": 50}'


def test_render_writes_an_npz_that_can_be_replayed(scene_file, pose_file, tmp_path):
    output = tmp_path / "frames.npz"
    result = succeeded(
        *("render", scene_file, "--poses", pose_file, "--height", 16, "--width", 12),
        *("--outputs", "bmode,transmittance", "-o", output),
    )
    assert "7 frames of 16x12" in result.output
    with np.load(output) as frames:
        told = {field.name for field in fields(SettingsUsed)}
        assert set(frames) - told == {"bmode", "transmittance", "poses", *FIGURES, *ORIGIN} - told
        assert str(frames["scene"]) == "scene"
        assert str(frames["scene_sha256"]) == file_sha256(scene_file)
        assert str(frames["renderer"]) == f"ultragray/{ultragray.__version__} cpu-{cpu.INSTRUCTION_SETS[0]}"
        again = render(GaussianScene.load(scene_file), None, frames["poses"], height=16, width=12)
        for name in ("bmode", "transmittance"):
            assert frames[name].dtype == np.float32
            assert frames[name].max() > 0.05
            np.testing.assert_allclose(frames[name], getattr(again, name).numpy(), atol=1e-6)


def test_without_poses_the_training_views_are_rendered_as_trained(scene_file, tmp_path):
    succeeded("render", scene_file, "-o", tmp_path / "f.npz")
    with np.load(tmp_path / "f.npz") as frames:
        assert frames["bmode"].shape == (5, 24, 20)


def test_display_settings_vary_within_a_batch_and_are_told(scene_file, tmp_path):
    output = tmp_path / "f.npz"
    line = ("render", scene_file, "--gain-db", "-6:6", "--display-seed", 3, "--height", 16, "--width", 12, "-o", output)
    succeeded(*line)
    with np.load(output) as frames:
        display = from_dict(Display, json.loads(str(frames["display"])))
        assert display == Display(gain_db_between=(-6.0, 6.0), display_seed=3)
        scene = GaussianScene.load(scene_file)
        for pose, bmode in zip(frames["poses"], frames["bmode"], strict=True):
            plain = render(scene, None, pose, height=16, width=12, outputs=("bmode",))
            expected = show(plain, scene.info.probe, display.of_frame(pose))["bmode"]
            np.testing.assert_allclose(bmode, expected[0].numpy(), atol=1e-6)


def test_render_writes_pngs(scene_file, tmp_path):
    folder, npz = tmp_path / "pictures", tmp_path / "f.npz"
    arguments = ("render", scene_file, "--outputs", "bmode,coverage", "-o")
    succeeded(*arguments, folder)
    succeeded(*arguments, npz)
    names = sorted(p.name for p in folder.iterdir())
    pictures = [f"frame_{i:05d}_{output}.png" for i in range(5) for output in ("bmode", "coverage")]
    assert names == [*pictures, "frames.json"]
    with np.load(npz) as frames:
        for output in ("bmode", "coverage"):
            picture = cv2.imread(str(folder / f"frame_00003_{output}.png"), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(picture, np.rint(frames[output][3] * 255))


@pytest.fixture
def knowing_file(scene_file, tmp_path):
    """The scene with a model of its confidence."""
    scene = GaussianScene.load(scene_file)
    model = ConfidenceModel((3.5, 1.2, 0.8, 0.1, 0.6), 0.06, (0.125,) * 5, 20, 0.04)
    replace(scene, info=replace(scene.info, confidence=model.to_dict())).save(tmp_path / "knowing.ugr")
    return tmp_path / "knowing.ugr"


def test_render_tells_and_stores_how_far_frames_extrapolate(knowing_file, scene_file, tmp_path):
    scene = GaussianScene.load(knowing_file)
    coverage = render(scene, None, scene.training_poses, height=24, width=20, outputs=("coverage",)).coverage
    expected = Assessor(scene.info, scene.training_poses).assess(scene.training_poses, coverage=coverage.numpy())
    figures = figure_arrays(expected)
    low, high = figures["confidence"].min(), figures["confidence"].max()
    share = f"Gaussians support {figures['supported_share'].mean():.0%} of the pixels"

    result = run("render", knowing_file, "-o", tmp_path / "pictures")
    assert result.output.endswith(f"; confidence {low:.2f} to {high:.2f}, {share}\n")
    told = json.loads((tmp_path / "pictures" / "frames.json").read_text())
    assert [one["frame"] for one in told] == [0, 1, 2, 3, 4]
    for one, extrapolation, pose in zip(told, expected, scene.training_poses, strict=True):
        assert {name: one[name] for name in FIGURES} == pytest.approx(extrapolation.figures())
        assert one["pose"] == pose.tolist()

    assert run("render", scene_file, "-o", tmp_path / "f.npz").output.endswith(f" s; {share}\n")
    with np.load(tmp_path / "f.npz") as frames:
        np.testing.assert_allclose(frames["supported_share"], figures["supported_share"])
        np.testing.assert_allclose(frames["angle_deg"], figures["angle_deg"], rtol=1e-6)
        assert np.isnan(frames["confidence"]).all()


def test_render_draws_the_tools_of_a_file(scene_file, tmp_path):
    scene = GaussianScene.load(scene_file)
    needle = Needle(tip_mm=(5.0, 0.0, 25.0), hub_mm=(-12.0, 0.0, 8.0), frame=ToolFrame.PROBE)
    file, output = tmp_path / "tools.json", tmp_path / "f.npz"
    file.write_text(json.dumps(to_dict((needle,))))
    arguments = ("render", scene_file, "-o", output, "--outputs", "bmode,labels", "--tools", file)
    succeeded(*arguments, "--ghost", 0.5)
    size = {"height": 24, "width": 20, "outputs": ("bmode", "labels")}
    expected = render(scene, None, scene.training_poses, **size, tools=(needle,), ghost=0.5)
    with np.load(output) as frames:
        np.testing.assert_allclose(frames["bmode"], expected["bmode"].numpy(), atol=1e-6)
        np.testing.assert_array_equal(frames["labels"], expected["labels"].numpy())
        assert json.loads(str(frames["tools"])) == to_dict((needle,))
    file.write_text('[{"kind": "needle", "tip_mm": [0, 0, 1]}]')
    told = refused(*arguments, "--force")
    assert f"{file}: tools[0].hub_mm is required by the tool needle" in told
    file.write_text(json.dumps(to_dict((needle,) * 9)))
    assert "tools must be a list of at most 8 values, got 9" in refused(*arguments, "--force")


def test_render_keeps_to_a_least_confidence(knowing_file, scene_file, tmp_path):
    scene = GaussianScene.load(knowing_file)
    arguments = ("render", knowing_file, "-o", tmp_path / "f.npz", "--force", "--min-confidence", 0.5)
    succeeded(*arguments, "--sampler", "around", "--count", 30, "--translation-mm", 8)
    with np.load(tmp_path / "f.npz") as frames:
        assert frames["confidence"].shape == (30,)
        assert frames["confidence"].min() >= 0.5

    poses = scene.training_poses.copy()
    poses[3, :3, 3] += 50.0 * poses[3, :3, 1]
    np.save(tmp_path / "far.npy", poses)
    assert "poses[3] has a confidence of" in refused(*arguments, "--poses", tmp_path / "far.npy")
    succeeded(*arguments, "--poses", tmp_path / "far.npy", "--sampler", "training")
    with np.load(tmp_path / "f.npz") as frames:
        np.testing.assert_array_equal(frames["poses"], poses[[0, 1, 2, 4]])
    assert "needs a scene that knows" in refused("render", scene_file, *arguments[2:])


def test_render_samples_poses_into_the_format_of_the_name(scene_file, pose_file, tmp_path):
    sampler = ("--sampler", "fan", "--tilt-deg", 2, "--step-deg", 2, "--poses", pose_file)
    for name in ("f.npz", "f.igs.mha", "f.h5"):
        result = succeeded("render", scene_file, *sampler, "--dtype", "uint8", "-o", tmp_path / name)
        assert "21 frames of 24x20" in result.output
    with np.load(tmp_path / "f.npz") as frames:
        np.testing.assert_array_equal(frames["poses"], FanSampler(2, 2).poses(np.load(pose_file), LINEAR))
        sweep, _ = read_plus_sweep(tmp_path / "f.igs.mha")
        np.testing.assert_array_equal(sweep.images, frames["bmode"])
        np.testing.assert_allclose(sweep.poses, frames["poses"], atol=1e-9)
        with h5py.File(tmp_path / "f.h5") as file:
            np.testing.assert_array_equal(file["bmode"], frames["bmode"])


def test_threads_and_backend_are_used(scene_file, tmp_path):
    succeeded("render", scene_file, "-o", tmp_path / "f.npz", "--threads", 3, "--backend", "reference")
    assert torch.get_num_threads() == 3
    with np.load(tmp_path / "f.npz") as frames:
        assert str(frames["renderer"]).endswith(" reference")


def test_what_is_there_is_replaced_only_with_force(scene_file, tmp_path):
    file, folder = tmp_path / "f.npz", tmp_path / "pictures"
    file.write_text("mine")
    folder.mkdir()
    (folder / "notes.txt").write_text("mine")
    small = ("render", scene_file, "--height", 8, "--width", 8, "-o")
    assert f"{file} exists: --force replaces it" in refused(*small, file)
    assert f"{folder} holds files: --force writes among them" in refused(*small, folder)
    assert file.read_text() == "mine"
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]
    assert run(*small, file, "--force").exit_code == run(*small, folder, "--force").exit_code == 0
    assert np.load(file)["bmode"].shape == (5, 8, 8)
    assert (folder / "frame_00000_bmode.png").exists()
    assert (folder / "notes.txt").exists()


def test_a_sentence_for_people_is_a_document_for_programs(scene_file, tmp_path):
    output = tmp_path / "f.npz"
    result = run("render", scene_file, "-o", output, "--json", "--height", 8, "--width", 8)
    document = json.loads(result.stdout)
    assert (document["output"], document["frames"], document["height"]) == (str(output), 5, 8)
    assert document["confidence_min"] is None


def test_a_scene_that_knows_no_probe_or_poses_asks_for_them(tmp_path, random_scene):
    path = tmp_path / "bare.ugr"
    random_scene(3).save(path)
    assert "--probe must be given" in refused("render", path, "-o", tmp_path / "f.npz")
    assert "--poses must be given" in refused("render", path, "-o", tmp_path / "f.npz", "--probe", CONVEX_JSON)

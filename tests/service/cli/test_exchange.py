"""Commands that make files of files: `export`, `import`, `check`, `convert`, `voxelize`, `localize`, `calibrate` …"""

import json

import nibabel
import numpy as np
import pytest

from ultragray import GaussianScene, LinearProbe, phantom, render
from ultragray.datasets.released import write_released
from ultragray.datasets.source import load_dataset
from ultragray.geometry.registration import load_registration
from ultragray.learn.training.agreement import agreed_path, with_shares
from ultragray.phantom.demo import DEMO_FILE, copy_demo_scene, demo_poses, load_demo_scene
from ultragray.rendering.pixels import png_file
from ultragray.scene.info import read_header
from ultragray_workers.datasets.intake import check_files
from ultragray_workers.storage.location import open_storage

from ...model.learn.training.test_agreement import FRAMES, PROBE, hand_path, recording
from ...model.test_registration import motion
from ...workers.jobs.conftest import store_dataset
from .command_line import noise_sweep, refused, run, succeeded


@pytest.fixture
def make_file(tmp_path, random_scene, random_poses):
    def make(**options):
        info = {"probe": LinearProbe(30.0, 0.0, 40.0), "image_height": 24, "image_width": 20}
        made = random_scene(60, info=info, **options)
        path = tmp_path / "scene.ugr"
        GaussianScene.from_splats(made.splats, info=made.info, training_poses=random_poses(5)).save(path)
        return path

    return make


def test_a_ply_and_back_is_the_same_file(make_file, tmp_path):
    scene = make_file(intensity="sigmoid")
    result = run("export", scene, "-o", tmp_path / "a.ply")
    assert (result.exit_code, result.stderr) == (0, "")
    assert "60 Gaussians, 5 training poses" in result.stdout
    succeeded("import", tmp_path / "a.ply", "-o", tmp_path / "b.ugr")
    assert (tmp_path / "b.ugr").read_bytes() == scene.read_bytes()


def test_a_compressed_scene_is_a_scene_file_itself(make_file, tmp_path):
    scene, small = make_file(), tmp_path / "small.ugz"
    result = run("export", scene, "-o", small)
    assert (result.exit_code, result.stderr) == (0, "")
    assert f"{small.stat().st_size / 1e6:.2f} MB" in result.stdout
    assert small.read_bytes() == GaussianScene.load(scene).to_compressed_bytes()
    assert json.loads(run("show", small, "--json").stdout)["gaussian_count"] == 60
    succeeded("render", small, "-o", tmp_path / "frames.npz")
    succeeded("export", small, "-o", tmp_path / "a.ply")


def test_a_scene_is_given_a_mode_of_motion_and_rendered_at_a_phase(make_file, tmp_path):
    moving = tmp_path / "moving.ugr"
    result = run("motion", make_file(), "-o", moving, "--chest-mm", "8")
    assert (result.exit_code, result.stderr) == (0, "")
    assert "breathing between 0 and 1, at rest at 0" in result.stdout
    assert read_header(moving).info.motion.modes[0].name == "breathing"
    frames = []
    for phase in ("0", "1"):
        made = run("render", moving, "-o", tmp_path / f"{phase}.npz", "--phase", phase)
        assert (made.exit_code, made.stderr) == (0, "")
        frames.append(np.load(tmp_path / f"{phase}.npz")["bmode"])
    assert not np.array_equal(*frames)
    none = tmp_path / "none.ugr"
    assert "exactly one of chest_mm, pulse_mm, sweep, field, got none" in refused("motion", moving, "-o", none)
    assert "--sweep and --surrogate belong together" in refused("motion", moving, "-o", none, "--sweep", "s.mha")
    assert "a mode that is called breathing" in refused("motion", moving, "-o", none, "--chest-mm", "8")


def test_a_field_of_displacements_becomes_a_mode_beside_a_vessel_that_pulsates(make_file, tmp_path):
    field, inhaling, both = tmp_path / "inhale.nii.gz", tmp_path / "inhaling.ugr", tmp_path / "both.ugr"
    vectors = np.broadcast_to([0.0, 0.0, 4.0], (5, 5, 5, 3))
    affine = np.diag([30.0, 30.0, 30.0, 1.0])
    affine[:3, 3] = -60.0
    nibabel.save(nibabel.Nifti1Image(vectors, affine), field)
    asked = ("motion", make_file(), "-o", inhaling, "--field", field)
    assert "field and field_leads belong together" in refused(*asked)
    assert "in which axes its vectors are" in refused(*asked, "--field-leads", "from-rest")
    made = run(*asked, "--field-leads", "from-rest", "--field-axes", "ras", "--json")
    facts = json.loads(made.stdout)
    assert facts["residual_mm"]["most"] < 1e-5
    tube = json.dumps({"kind": "tube", "points_mm": [[0, -20, 15], [0, 20, 15]], "radius_mm": 6})
    result = run("motion", inhaling, "-o", both, "--pulse-mm", "0.5", "--vessel", tube)
    assert "pulse between 0 and 1" in result.stdout
    assert [mode.name for mode in read_header(both).info.motion.modes] == ["breathing", "pulse"]
    assert run("render", both, "-o", tmp_path / "frame.npz", "--phase", "1,0.5").exit_code == 0
    assert "one number for each mode" in refused("render", both, "-o", tmp_path / "f.npz", "--phase", "1")


def test_a_checkpoint_and_back_by_the_documented_commands(make_file, tmp_path):
    folder = tmp_path / "released"
    result = run("export", make_file(), "-o", folder / "ckpt_0.pt")
    assert (result.exit_code, result.stderr) == (0, "")
    assert all(str(folder / name) in result.stdout for name in ("ckpt_0.pt", "conf.json", "poses_train.npy"))
    back = succeeded(
        *("import", folder / "ckpt_0.pt", "--config", folder / "conf.json"),
        *("--poses", folder / "poses_train.npy", "-o", tmp_path / "back.ugr"),
    )
    assert "60 Gaussians" in back.stdout


def test_what_the_released_format_cannot_hold_is_noted(make_file, tmp_path):
    result = succeeded("export", make_file(intensity="sigmoid"), "-o", tmp_path / "out" / "ckpt.pt")
    assert result.stderr.startswith("note: its intensities are `sigmoid`")


@pytest.fixture
def folder(tmp_path):
    return noise_sweep(tmp_path / "tiny", 12)


def test_check_prints_a_table_and_warnings(folder):
    result = succeeded("check", folder, "--train-frames", "0:4,8:10")
    assert "tiny: linear probe (width 40 mm, near 0 mm, far 50 mm)" in result.output
    assert [line.split()[-2:] for line in result.output.splitlines() if line.startswith("frames ")] == [["6", "2"]]
    assert "held-out frames lie 1.50 mm (median) to 2.00 mm" in result.output
    assert "nothing suspicious" in result.output
    poses = np.load(folder / "poses_train.npy")
    poses[4, 0, 3] = 30.0
    np.save(folder / "poses_train.npy", poses)
    result = succeeded("check", folder)
    assert "warning: train: frame 4 lies 30.0 mm off" in result.output


def test_a_sweep_of_any_size_is_described_and_its_warnings_are_the_same_at_every_door(folder):
    """Both parts have voxels of their own size where a volume is large: a row of the table says both."""
    poses = np.load(folder / "poses_train.npy")
    poses[4, :3, 3] = 600.0, 300.0, 1900.0
    np.save(folder / "poses_train.npy", poses)
    result = succeeded("check", folder)
    assert "crossed voxels, mL (voxel, mm)" in result.output
    assert "Probe → Tracker: pose of poses_train.npy, tracked" in result.output
    document = json.loads(run("check", folder, "--json").output)
    assert any("frame 4 lies 20" in text and "a wrong pose?" in text for text in document["warnings"])
    told = [line.removeprefix("warning: ") for line in result.output.splitlines() if line.startswith("warning: ")]
    record = check_files(folder, "tiny", {}, folder.parent / "sheet.png")
    assert told == document["warnings"] == list(record.warnings)
    assert document["chain"]["links"][0]["transform"] == "pose"


def test_convert_leaves_names_out(folder):
    for part in ("train", "val"):
        images = np.load(folder / f"images_{part}.npy")
        images[:, 2:5, 3:14] = 255
        images[:, 1:6, 2:15][:, ::4] = 0
        np.save(folder / f"images_{part}.npy", images)
    output = folder.parent / "nobody"
    result = succeeded("convert", folder, "-o", output, "--anonymize", "--json")
    assert json.loads(result.output)["blackened_marks"] == 1
    assert json.loads((output / "conf.json").read_text())["_source"] == "anonymous"
    assert np.load(output / "images_train.npy")[:, 2:5, 3:14].max() == 0


def test_bad_data_is_one_line_and_exit_code_two(folder):
    poses = np.load(folder / "poses_train.npy")
    poses[3, 0, 3] = np.inf
    np.save(folder / "poses_train.npy", poses)
    for command in (["check"], ["convert", "-o", folder.parent / "other"], ["draw", "-o", folder.parent / "a.png"]):
        assert "frame 3: its pose must be finite" in refused(command[0], folder, *command[1:])
    assert sorted(path.name for path in folder.parent.iterdir()) == ["tiny"]


def test_says_that_the_phantom_takes_time(folder, monkeypatch):
    monkeypatch.setattr(phantom, "load_phantom", lambda: load_dataset(folder))
    result = run("check", "phantom", "--json")
    assert result.stderr == "simulating the phantom …\n"
    assert json.loads(result.stdout)["name"] == "tiny"
    assert run("check", folder).stderr == ""


def test_convert_writes_what_is_read_back(folder):
    result = succeeded("convert", folder, "-o", folder.parent / "half", "--image-size", "8x10", "--val-frames", "0:2")
    assert "8 training and 2 held-out frames of 8x10" in result.output
    assert load_dataset(folder.parent / "half").train.images.shape == (8, 10, 8)
    assert "new or empty folder" in refused("convert", folder, "-o", folder.parent / "half")
    succeeded("convert", folder, "-o", folder.parent / "half", "--force")
    assert load_dataset(folder.parent / "half").sha256 == load_dataset(folder).sha256


def test_poses_that_a_scene_of_following_tissue_was_trained_on_can_be_had(tmp_path):
    tracked = hand_path()
    given, sweep = recording(with_shares(tracked, [range(FRAMES)], PROBE, (0.0,) * 3), tracked), tmp_path / "sweep"
    write_released(given, sweep)
    given = load_dataset(sweep)
    settings = ("--steps", "1", "--max-gaussians", "60", "--no-confidence")
    told = succeeded("train", sweep, "-o", tmp_path / "scene.ugr", *settings).output
    assert "held out, on the path" in told
    assert "poses of 30 training frames were corrected by" in told
    scene, path = GaussianScene.load(tmp_path / "scene.ugr"), agreed_path(given)
    succeeded("convert", sweep, "--poses-of", tmp_path / "scene.ugr", "-o", tmp_path / "corrected")
    corrected = load_dataset(tmp_path / "corrected")
    for found, expected in ((corrected.train, scene.rest_poses), (corrected.val, path.val)):
        np.testing.assert_allclose(found.poses, expected, atol=1e-4)
    figures = json.loads(run("eval", tmp_path / "scene.ugr", sweep, "--json").stdout)
    moved_mm = np.linalg.norm((scene.rest_poses - given.train.poses)[:, :3, 3], axis=1)
    np.testing.assert_allclose(figures["pose_corrections"]["shift_mm"], moved_mm, atol=1e-3)
    assert moved_mm.max() > 0.5


def test_draw_draws_a_png(folder):
    picture = folder.parent / "sweep.png"
    succeeded("draw", folder, "-o", picture)
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    path = tmp_path_factory.mktemp("demo") / "demo.ugr"
    succeeded("demo", "-o", path)
    return path


def test_a_scene_becomes_a_volume_over_its_bounds(demo, tmp_path):
    result = succeeded("voxelize", demo, "-o", tmp_path / "v.nii.gz", "--spacing-mm", 3, "--field", "labels", "--json")
    document = json.loads(result.stdout)
    image = nibabel.load(tmp_path / "v.nii.gz")
    assert list(image.shape) == document["shape"]
    np.testing.assert_allclose(image.affine, document["affine"], atol=1e-4)
    present = {str(label) for label in np.unique(np.asarray(image.dataobj)) if label}
    assert present
    assert present <= set(document["label_names"])


def test_a_slice_through_a_plane(demo, tmp_path):
    plane = ("--plane-mm=-20,0,5", "--right", "1,0,0", "--down", "0,0.2,1", "--size-mm", "40,30", "--spacing-mm", 1)
    result = succeeded("voxelize", demo, "-o", tmp_path / "s.npy", *plane)
    assert "echo, 40 x 30 x 1 at 1 mm" in result.stdout
    assert np.load(tmp_path / "s.npy").shape == (30, 40)


def test_a_box_beyond_the_scene_is_warned_of(demo, tmp_path):
    box = ("--box-mm", "5000:5010,0:10,0:10", "--spacing-mm", 5)
    result = succeeded("voxelize", demo, "-o", tmp_path / "v.nii", *box)
    assert "box_mm lies beyond all Gaussians, which are in -" in result.stderr
    assert "warning" not in run("voxelize", demo, "-o", tmp_path / "w.nii", "--spacing-mm", 8).stderr


@pytest.fixture
def frame(tmp_path):
    """A picture of the demo scene, and its pose; `start.npy` beside it is a few millimetres off."""
    pose = demo_poses(3)[1]
    pixels = render(load_demo_scene(), None, pose, height=192, width=192, outputs=("bmode",))["bmode"][0]
    path = tmp_path / "frame.png"
    path.write_bytes(png_file(pixels.detach().numpy()))
    start = pose.copy()
    start[:3, 3] += (1.5, -1.0, 1.0)
    np.save(tmp_path / "start.npy", start)
    return path, pose


def test_the_pose_is_found_and_written(frame, tmp_path):
    path, pose = frame
    found = tmp_path / "found.npy"
    result = succeeded("localize", DEMO_FILE, path, "--start", tmp_path / "start.npy", "-o", found, "--json")
    document = json.loads(result.stdout)
    assert document["is_found"]
    np.testing.assert_allclose(document["pose"], pose, atol=0.2)
    np.testing.assert_array_equal(np.load(found), document["pose"])


def test_a_frame_of_something_else_is_not_found(tmp_path):
    np.save(tmp_path / "noise.npy", np.random.default_rng(0).integers(0, 256, (96, 96), dtype=np.uint8))
    np.save(tmp_path / "start.npy", demo_poses(3)[1])
    found = tmp_path / "found.npy"
    result = run("localize", DEMO_FILE, tmp_path / "noise.npy", "--start", tmp_path / "start.npy", "-o", found)
    assert result.exit_code == 1, result.output
    assert result.stdout.startswith("not found: ")
    assert not found.exists()


def test_mistakes_of_localize_are_told_in_one_line(tmp_path):
    start = tmp_path / "start.npy"
    np.save(start, demo_poses(3))
    (tmp_path / "text.png").write_text("no picture")
    assert "must hold one pose, got 3" in refused("localize", DEMO_FILE, tmp_path / "text.png", "--start", start)
    np.save(start, demo_poses(1))
    assert "No such file" in refused("localize", DEMO_FILE, tmp_path / "none.png", "--start", start)
    assert "image must be a PNG file" in refused("localize", DEMO_FILE, tmp_path / "text.png", "--start", start)
    np.save(tmp_path / "objects.npy", np.array([{}], dtype=object), allow_pickle=True)
    assert "it holds Python objects" in refused("localize", DEMO_FILE, tmp_path / "objects.npy", "--start", start)
    np.save(tmp_path / "bytes.npy", np.full((64, 64), 200.0))
    told = refused("localize", DEMO_FILE, tmp_path / "bytes.npy", "--start", start)
    assert "in [0, 1], or uint8, got float64 from 200 to 200" in told


def test_points_are_registered_and_residuals_told(tmp_path):
    rng = np.random.default_rng(0)
    true, points = motion(rng), 50.0 * rng.normal(size=(5, 3))
    np.savetxt(tmp_path / "base.csv", points, delimiter=",")
    np.save(tmp_path / "scene.npy", points @ true[:3, :3].T + true[:3, 3])
    output = tmp_path / "robot.json"
    result = succeeded("calibrate", "points", tmp_path / "base.csv", tmp_path / "scene.npy", "-o", output)
    assert "from 5 points" in result.stdout
    assert "residuals: " in result.stdout
    np.testing.assert_allclose(load_registration(output).base_to_scene, true, atol=1e-9)
    assert "exists: --force" in refused(
        "calibrate", "points", tmp_path / "base.csv", tmp_path / "scene.npy", "-o", output
    )


def test_poses_give_the_mounting_as_well(tmp_path):
    rng = np.random.default_rng(1)
    base_to_scene, mounting = motion(rng), motion(rng)
    flanges = np.stack([motion(rng) for _ in range(5)])
    np.save(tmp_path / "flange.npy", flanges)
    np.save(tmp_path / "probe.npy", base_to_scene @ flanges @ mounting)
    np.save(tmp_path / "mounting.npy", mounting)
    asked = ("calibrate", "poses", tmp_path / "flange.npy", tmp_path / "probe.npy", "-o", tmp_path / "robot.json")
    document = json.loads(run(*asked, "--find-mounting", "--json").stdout)
    np.testing.assert_allclose(document["probe_to_flange"], mounting, atol=1e-6)
    given = json.loads(run(*asked, "--probe-to-flange", tmp_path / "mounting.npy", "--json", "--force").stdout)
    np.testing.assert_allclose(given["base_to_scene"], base_to_scene, atol=1e-6)
    both = ("--find-mounting", "--probe-to-flange", tmp_path / "mounting.npy", "--force")
    assert "name one of them" in refused(*asked, *both)


def test_samples_that_contradict_each_other_end_with_a_status_that_a_script_sees(tmp_path):
    rng = np.random.default_rng(1)
    base_to_scene, mounting = motion(rng), motion(rng)
    flanges = np.stack([motion(rng) for _ in range(8)])
    np.save(tmp_path / "flange.npy", flanges)
    np.save(tmp_path / "probe.npy", (base_to_scene @ flanges @ mounting)[[0, 3, 2, 1, 4, 5, 6, 7]])
    asked = ("calibrate", "poses", tmp_path / "flange.npy", tmp_path / "probe.npy", "-o", tmp_path / "robot.json")
    result = run(*asked, "--find-mounting", "--json")
    assert result.exit_code == 1
    (told,) = json.loads(result.stdout)["warnings"]
    assert told.startswith("the samples contradict each other: sample ")
    assert "samples 1 and 3 are exchanged" in told
    assert told in result.stderr
    assert not (tmp_path / "robot.json").exists()
    points = 50.0 * rng.normal(size=(6, 3))
    np.save(tmp_path / "base.npy", points)
    np.save(tmp_path / "scene.npy", (points @ base_to_scene[:3, :3].T)[[0, 1, 2, 4, 3, 5]])
    result = run("calibrate", "points", tmp_path / "base.npy", tmp_path / "scene.npy", "-o", tmp_path / "points.json")
    assert result.exit_code == 1
    assert "samples 3 and 4 are exchanged" in result.stderr


def test_frames_register_a_robot(tmp_path):
    base_to_scene, poses = motion(np.random.default_rng(2)), demo_poses(5)[1:4]
    frames = render(load_demo_scene(), None, poses, height=96, width=96, outputs=("bmode",))["bmode"]
    np.save(tmp_path / "frames.npy", frames.detach().numpy())
    np.save(tmp_path / "flange.npy", np.linalg.inv(base_to_scene) @ poses)
    about = base_to_scene.copy()
    about[:3, 3] += (1.0, -1.0, 0.5)
    np.save(tmp_path / "about.npy", about)
    asked = ("calibrate", "frames", DEMO_FILE, tmp_path / "flange.npy", tmp_path / "frames.npy")
    result = succeeded(*asked, "--start", tmp_path / "about.npy", "-o", tmp_path / "robot.json", "--json")
    document = json.loads(result.stdout)
    assert document["left_out"] == []
    found = np.array(document["base_to_scene"]) @ np.linalg.inv(base_to_scene) @ poses
    np.testing.assert_allclose(found, poses, atol=0.3)


def test_mistakes_of_calibrate_are_told_in_one_line(tmp_path):
    np.save(tmp_path / "line.npy", np.outer(np.arange(4.0), np.ones(3)))
    output = ("-o", tmp_path / "robot.json")
    line = refused("calibrate", "points", tmp_path / "line.npy", tmp_path / "line.npy", *output)
    assert "points lie on a line" in line
    assert not (tmp_path / "robot.json").exists()


def test_an_installation_goes_into_a_bucket(tmp_path, new_bucket):
    data, bucket = tmp_path / "data", new_bucket()
    store_dataset(data / "artifacts", "tiny")
    copy_demo_scene(data / "demo.ugr")
    result = run("storage", "copy", data, bucket)
    assert (result.exit_code, result.stdout.count("1 copied")) == (0, 2), result.output
    keys = {entry.key for entry in open_storage(bucket).entries()}
    assert {"demo.ugr", "artifacts/datasets/tiny.json"} < keys
    again = json.loads(run("storage", "copy", data, bucket, "--json").stdout)
    assert (again["scenes"], again["datasets"]) == (0, 0)
    assert (again["already_there"], again["datasets_already_there"]) == (1, 1)

"""What a report says about a sweep and warns of, the voxels that its planes cross, and its picture."""

import json
import math
import re
import tracemalloc
from dataclasses import replace
from itertools import product

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from ultragray import ConvexProbe, LinearProbe, PhasedProbe
from ultragray.contract import to_dict
from ultragray.datasets import Dataset, Sweep, checks
from ultragray.datasets.checks import MAX_VOXELS, check_dataset, check_sweep, swept_volume, without_names
from ultragray.datasets.pictures import _draw_planes, draw_dataset
from ultragray.datasets.source import load_dataset
from ultragray.geometry.rotations import rotations_of


def test_a_straight_sweep(make_sweep):
    report = check_sweep(make_sweep(11, step_mm=0.5))
    assert (report.frames, report.height, report.width) == (11, 20, 16)
    assert report.pixel_axial_mm == pytest.approx(2.5)
    assert report.pixel_lateral_mm == pytest.approx(2.5)
    assert report.extent_min_mm == pytest.approx((-15, 0, 7))
    assert report.extent_max_mm == pytest.approx((25, 5, 57))
    assert report.path_mm == pytest.approx(5)
    assert report.step_median_mm == report.step_max_mm == pytest.approx(0.5)
    assert report.tilt_deg == pytest.approx(0)
    assert report.coverage == pytest.approx(1.0)  # frames closer than the voxels of 1 mm
    assert report.swept_ml == pytest.approx(40 * 5 * 50 / 1000)
    assert report.warnings == ()


def test_tilts_are_told_by_axis(make_sweep):
    poses = np.tile(np.eye(4), (5, 1, 1))
    for pose, degrees in zip(poses, (-20, -10, 0, 10, 15), strict=True):
        angle = np.radians(degrees)
        pose[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]  # about x, the lateral axis
    report = check_sweep(make_sweep(5, poses=poses))
    assert report.tilt_deg == pytest.approx(35)
    assert report.tilt_range_deg == pytest.approx((35, 0, 0), abs=1e-9)
    assert report.step_max_deg == pytest.approx(10)


def warnings_of(sweep):
    return "\n".join(check_sweep(sweep).warnings)


def test_a_pose_off_its_neighbours_is_named(make_sweep):
    poses = make_sweep(12).poses.copy()
    poses[7, 0, 3] += 20.0
    text = warnings_of(make_sweep(12, poses=poses, frame_numbers=np.arange(100, 112)))
    assert text.startswith("frame 107 lies 20.0 mm off the frame before and 20.0 mm off the one after it")
    assert "\n" not in text


def test_a_lost_pose_is_named_whichever_part_it_is_in(make_sweep, without_path):
    """A tracker that lost the probe says that it lies at its own origin, 2 m away."""
    for lost in (4, 7, 0):
        poses = make_sweep(30).poses.copy()
        poses[:, :3, 3] += -190.0, -98.0, -1949.0
        poses[lost] = np.eye(4)
        sweep = make_sweep(30, poses=poses)
        held_out = np.arange(30) % 5 == 2
        parts = sweep.select(np.flatnonzero(~held_out)), sweep.select(np.flatnonzero(held_out))
        report = check_dataset(Dataset("one", *parts))
        told = f"frame {lost} lies 19" if lost else "a jump of 19"
        assert [text for text in report.warnings if text.startswith(told)]
        assert {report.train.voxel_mm > 1.0, report.val is not None and report.val.voxel_mm > 1.0} == {True, False}


def test_positions_in_millimetres_where_metres_are_expected_are_named(make_sweep):
    sweep = make_sweep(24, step_mm=1000.0)
    (told,) = check_dataset(Dataset("one", sweep, sweep.select([]))).warnings
    assert told == (
        "the probe goes 1000 mm from frame to frame, 23 m in all: positions in millimetres where metres are expected?"
    )


def test_what_comes_of_wrong_units_is_not_told_to_come_of_tissue(make_sweep):
    poses = make_sweep(30).poses
    poses[:, 0, 3] += 3.0 * np.sin(np.arange(30) / 3.0)
    told = []
    for unit in (1.0, 1000.0):
        poses[:, :3, 3] *= unit
        sweep = make_sweep(30, images=moving_texture(30), poses=poses)
        report = check_dataset(Dataset("one", sweep, sweep.select([])))
        assert "tissue" in report.path.causes
        told.append([text for text in report.warnings if "tissue" in text])
    assert [len(texts) for texts in told] == [1, 0]


def moving_texture(count=20):  # [count, 96, 128]
    """Texture that changes slowly from frame to frame."""
    random = np.random.default_rng(1)
    ends = [cv2.GaussianBlur(random.normal(size=(96, 128)).astype(np.float32), (0, 0), 2.0) for _ in range(3)]
    shares = np.linspace(0, 2, count)
    frames = [ends[int(min(s, 1.99))] * (1 - s % 1) + ends[int(min(s, 1.99)) + 1] * (s % 1) for s in shares[:-1]]
    return np.clip(110 + 300 * np.stack([*frames, ends[2]]), 1, 250).astype(np.uint8)


@pytest.fixture
def without_path(monkeypatch):
    """No other path is looked for, which takes a second: tests of the path itself are beside the training's."""
    monkeypatch.setattr(checks, "agreed_path", lambda dataset: None)


@pytest.mark.parametrize("height", [12, 24])
def test_text_that_is_burnt_in_is_named_with_its_place_and_made_black(make_sweep, without_path, height):
    plain = moving_texture()
    images = plain.copy()
    for image in images:
        cv2.putText(image, "DOE JANE", (6, 30), cv2.FONT_HERSHEY_SIMPLEX, height / 24, 255, 1, cv2.LINE_AA)
        image[::8, 122:126] = 200  # a ruler
    sweep = make_sweep(len(images), images=images)
    dataset = Dataset("DOE", sweep.select(range(15)), sweep.select(range(15, 20)))
    report = check_dataset(dataset)
    (told,) = (text for text in report.warnings if "never change" in text)
    assert told.endswith("text or a ruler burnt in, perhaps a name? Crop it away")
    cleaned, marks = without_names(dataset)
    assert (cleaned.name, marks >= 2) == ("anonymous", True)
    assert not [text for text in check_dataset(cleaned).warnings if "never change" in text]
    text = np.abs(images[0].astype(int) - plain[0]) > 60
    text &= images[0] > 200
    assert cleaned.train.images[0][text].max() == 0
    assert np.mean(cleaned.train.images != sweep.images[:15]) < 0.45
    assert not [
        text for text in check_dataset(replace(dataset, train=sweep_of(sweep, plain))).warnings if "never" in text
    ]


def sweep_of(sweep, images):
    return replace(sweep.select(range(15)), images=images[:15])


def test_a_picture_that_changes_at_once_is_named(make_sweep):
    images = moving_texture()
    assert not [text for text in warnings_of(make_sweep(20, images=images)).splitlines() if "at once" in text]
    for frame in range(12, 20):  # half the depth from there on
        images[frame] = cv2.resize(images[frame][:48, 32:96], (128, 96))
    told = warnings_of(make_sweep(20, images=images))
    assert "the picture changes at once from frame 11 to 12" in told
    assert "was the depth or another setting changed?" in told
    assert told.count("at once") == 1


def test_a_frame_turned_in_place_is_named_however_small_its_image_is(make_sweep):
    probe = LinearProbe(width_mm=4.0, near_mm=0.0, far_mm=5.0)
    for axis, step_mm in product(np.eye(3), (0.5, 5.0)):
        sweep = make_sweep(20, step_mm=step_mm, probe=probe)
        assert not any("wrong pose" in one for one in check_sweep(sweep).warnings)
        sweep.poses[7, :3, :3] = rotations_of(np.pi / 2 * axis[None])[0]
        warnings = [one for one in check_sweep(sweep).warnings if "wrong pose" in one]
        assert len(warnings) == 1, (axis, step_mm)
        assert warnings[0].startswith("frame 7 ")


@pytest.mark.parametrize("apart_mm", [5.0, 30.0])
def test_two_trackers_in_turn_are_named(make_sweep, apart_mm):
    sweep = make_sweep(20)
    sweep.poses[:, :3, 3] += np.random.default_rng(0).normal(0, 3.0, (20, 3))
    assert not any("to and fro" in one for one in check_sweep(sweep).warnings)
    sweep = make_sweep(20)
    sweep.poses[::2, 0, 3] += apart_mm
    assert any(re.search(r"the probe goes [\d.]+ mm to and fro from frame", one) for one in check_sweep(sweep).warnings)


def test_a_gap_is_named_but_frames_that_were_left_out_are_none(make_sweep):
    sweep = make_sweep(40)
    assert check_sweep(sweep.select([*range(10), *range(25, 40)])).warnings == ()  # fifteen frames, fifteen millimetres
    gap = make_sweep(25, poses=sweep.poses[[*range(10), *range(25, 40)]])
    assert warnings_of(gap).startswith("a jump of 16.0 mm from frame 9 to 10, where 1 mm are usual")


def test_steps_are_compared_with_those_of_a_probe_that_moves(make_sweep):
    """Not with those of one that rests, or of a tracker that gives each pose three times."""
    poses = make_sweep(120, step_mm=2.0).poses
    for rests in (np.arange(120) // 3 * 3, np.clip(np.arange(120) - 60, 0, 59), np.clip(np.arange(120), 0, 20)):
        report = check_sweep(make_sweep(120, poses=poses[rests]))
        assert not [text for text in report.warnings if "jump" in text]
    (told,) = (text for text in report.warnings if "share one pose" in text)
    assert told.startswith("frames 20 to 119 share one pose")


def test_a_probe_that_is_lifted_off_is_named_once(make_sweep):
    poses = make_sweep(40).poses.copy()
    poses[30:, 2, 3] -= 8.0 * np.arange(1, 11)
    told = warnings_of(make_sweep(40, poses=poses))
    assert told.startswith("steps of up to 8.1 mm from frame 29 to 39, where 1 mm are usual: a probe lifted off")
    assert "\n" not in told


def test_single_poses_off_their_neighbours_are_named_one_by_one(make_sweep):
    poses = make_sweep(40).poses.copy()
    poses[[10, 12, 20], 0, 3] += 20.0
    told = warnings_of(make_sweep(40, poses=poses)).splitlines()
    assert [text.split(" lies")[0] for text in told] == ["frame 10", "frame 12", "frame 20"]


def test_many_repeats_are_named_in_one_sentence(make_sweep):
    poses = make_sweep(21, step_mm=2.0).poses[np.arange(21) // 3 * 3]
    assert warnings_of(make_sweep(21, poses=poses)) == (
        "7 times 3 frames (of 0 to 20) share one pose, but show different images: tracking stalled?"
    )


def test_a_probe_that_rests_shows_how_little_a_picture_changes_not_how_much_another_may(make_sweep):
    rests = np.clip(np.arange(45) - 40, 0, 4)
    sweep = make_sweep(45, images=moving_texture(5)[rests], poses=make_sweep(5).poses[rests])
    assert "at once" not in warnings_of(sweep)


def test_black_pictures_do_not_change(make_sweep):
    """Whatever the noise in them; the picture changes where they begin and where they end."""
    images = moving_texture()
    noise = np.random.default_rng(0).integers(0, 2, images[5:12].shape, dtype=np.uint8)
    images[5:12] = noise
    told = [text for text in warnings_of(make_sweep(20, images=images)).splitlines() if "at once" in text]
    assert len(told) == 2
    assert "from frame 4 to 5" in told[0]
    assert "from frame 11 to 12" in told[1]


def test_repeats_are_named(make_sweep):
    sweep = make_sweep(8)
    stalled = sweep.poses.copy()
    stalled[5] = stalled[4]
    assert warnings_of(make_sweep(8, poses=stalled)) == (
        "frames 4, 5 share one pose, but show different images: tracking stalled?"
    )
    frozen = sweep.images.copy()
    frozen[3] = frozen[2] = frozen[1]
    assert warnings_of(make_sweep(8, images=frozen)) == (
        "frames 1, 2, 3 show one image at different poses: a frozen picture?"
    )
    assert warnings_of(sweep.select([0, 1, 2, 2, 3])) == "frames 2, 2 are the same frame: one pose, one image"


def test_dark_and_saturated_images_are_named(make_sweep):
    images = make_sweep(6).images.copy()
    images[1] //= 32
    images[4][:2] = 255
    assert check_sweep(make_sweep(6, images=images)).warnings == (
        "frames 1 are nearly black: no pixel reaches 16 of 255",
        "frames 4 are saturated: over 5% of the pixels are 255",
    )


def test_held_out_frames_are_measured_from_the_nearest_training_frame(make_sweep):
    sweep = make_sweep(10, notes=("something was assumed",))
    report = check_dataset(Dataset("one", sweep.select([0, 1, 2, 3, 9]), sweep.select([3, 5, 6])))
    assert report.val_distance_median_mm == pytest.approx(2.0)
    assert report.val_distance_max_mm == pytest.approx(3.0)
    assert report.val_angle_max_deg == pytest.approx(0.0)
    assert report.warnings == (
        "something was assumed",
        "held-out frames 3 are also training frames: metrics will flatter",
    )
    document = json.loads(json.dumps(to_dict(report)))
    assert document["probe"] == {"kind": "linear", "width_mm": 40.0, "near_mm": 0.0, "far_mm": 50.0}
    assert document["train"]["frames"] == 5


@pytest.mark.parametrize(
    ("probe", "told"),
    [
        (
            LinearProbe(379.269, 0, 50),
            "the image is 379 mm wide, where 5 to 200 mm are usual: a length in another unit?",
        ),
        (LinearProbe(0.379, 0, 50), "the image is 0.379 mm wide"),
        (LinearProbe(40, 0, 464.542), "the scan lines are 465 mm long, where 10 to 400 mm are usual"),
        (ConvexProbe(60, 0.5, 2.3), "the scan lines are 1.8 mm long"),
        (ConvexProbe(1.05, 50, 200), "the fan opens by 1.05°, where 5° and more are usual: an angle in radians?"),
    ],
)
def test_a_probe_in_other_units_is_named(make_sweep, probe, told):
    sweep = make_sweep(10, probe=probe)
    warnings = check_dataset(Dataset("one", sweep, sweep.select([]))).warnings
    assert [text[: len(told)] for text in warnings] == [told]


@pytest.mark.parametrize(
    ("scale", "turn_deg", "told"),
    [
        (1.0, 0.0, None),
        (1.0, 30.0, None),
        (0.1, 0.0, "lie within 3.9 mm, where scan lines are 50 mm long: positions in centimetres or metres?"),
        (0.001, 0.0, "lie within 0.039 mm, less than a pixel (2.5 mm): tracking stalled, or positions in metres?"),
        (0.001, 30.0, "lie within 0.039 mm and turn by 30°: a probe tilted in place, or positions not in millimetres?"),
    ],
)
def test_poses_in_other_units_are_named(make_sweep, scale, turn_deg, told):
    poses = make_sweep(40).poses.copy()
    poses[:, :3, 3] *= scale
    for pose, angle in zip(poses, np.radians(np.linspace(0, turn_deg, 40)), strict=True):
        pose[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    sweep = make_sweep(40, poses=poses)
    warnings = check_dataset(Dataset("one", sweep, sweep.select([]))).warnings
    assert warnings == (() if told is None else (f"the poses of all 40 training frames {told}",))


def test_images_are_compared_without_a_copy_of_them(make_sweep, without_path):
    images = np.random.default_rng(0).integers(0, 250, (64, 256, 256), dtype=np.uint8)
    small = LinearProbe(width_mm=4.0, near_mm=0.0, far_mm=5.0)
    sweep = make_sweep(64, images=images, probe=small, step_mm=0.1)
    dataset = Dataset("one", sweep, Sweep(images[:4], sweep.poses[:4] * 1.0, small, np.arange(4), "val"))
    tracemalloc.start()
    report = check_dataset(dataset)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "0, 1, 2, 3" in report.warnings[-1]
    assert peak < images.nbytes / 4


@pytest.mark.parametrize(
    ("name", "frames", "tilt_deg", "warnings"),
    [("spine_phantom", 17, 2.0, 0), ("ultranerf_liver", 180, 14.9, 1)],  # the latter is two sweeps: one jump
)
def test_real_sets(data_folder, name, frames, tilt_deg, warnings):
    report = check_sweep(load_dataset(data_folder / name).train)
    assert report.frames == frames
    assert report.tilt_deg == pytest.approx(tilt_deg, abs=0.1)
    assert len(report.warnings) == warnings


def test_one_frame_can_be_described(make_sweep):
    report = check_sweep(make_sweep(1, probe=LinearProbe(40, 0, 50)))
    assert (report.step_median_mm, report.tilt_deg) == (0.0, 0.0)


@pytest.mark.parametrize(("step_mm", "coverage"), [(0.5, 1.0), (2.0, 0.5), (4.0, 0.25)])
def test_coverage_falls_with_the_spacing(make_sweep, step_mm, coverage):
    swept = swept_volume(make_sweep(round(40 / step_mm) + 1, step_mm=step_mm))
    assert swept.voxel_mm == 1.0
    assert swept.coverage == pytest.approx(coverage, abs=0.03)
    assert swept.swept_ml == pytest.approx(40 * 40 * 50 * swept.coverage / 1000)


def test_a_fan_crosses_the_voxels_of_its_sector(make_sweep):
    probe = ConvexProbe(opening_angle_deg=60.0, near_mm=40.0, far_mm=100.0)
    swept = swept_volume(make_sweep(21, step_mm=0.5, probe=probe))
    assert swept.swept_ml == pytest.approx(math.radians(60) / 2 * (100**2 - 40**2) * 10 / 1000, rel=0.04)


def test_it_does_not_depend_on_the_frame_of_the_tracker(make_sweep, random_poses):
    sweep = make_sweep(21)
    turned = make_sweep(21, poses=random_poses(1, tilt_deg=170.0) @ sweep.poses)
    assert swept_volume(turned).swept_ml == pytest.approx(swept_volume(sweep).swept_ml, rel=0.02)


def test_flat_boxes_keep_the_limit_too(make_sweep):
    """Two poses far off, in the plane of the others: one layer of voxels."""
    poses = make_sweep(4, step_mm=0.0).poses.copy()
    poses[2, 0, 3], poses[3, 2, 3] = 100_000.0, 100_000.0
    swept = swept_volume(make_sweep(4, poses=poses))
    voxels = math.prod(math.ceil(side_mm / swept.voxel_mm) for side_mm in (100_000, 100_000))
    assert 0.9 * MAX_VOXELS < voxels <= MAX_VOXELS


def pixels_of(picture, colour):  # RGB
    return int((np.abs(picture.astype(int) - colour[::-1]).max(axis=-1) < 40).sum())


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize(
    "probe",
    [
        LinearProbe(40, 0, 50),
        ConvexProbe(opening_angle_deg=60, near_mm=20, far_mm=70),
        PhasedProbe(opening_angle_deg=90, far_mm=70),
    ],
    ids=["linear", "convex", "phased"],
)
def test_both_parts_are_drawn(make_sweep, tmp_path, probe):
    sweep = make_sweep(12, probe=probe)
    blue, red = (31, 119, 180), (214, 39, 40)
    draw_dataset(Dataset("both", sweep.select(range(8)), sweep.select(range(8, 12))), tmp_path / "both.png")
    draw_dataset(Dataset("one", sweep, sweep.select([])), tmp_path / "one.png")
    both, one = (cv2.imread(str(tmp_path / f"{name}.png")) for name in ("both", "one"))
    assert one is not None
    assert both.shape[1] == 1400
    assert pixels_of(both, blue) > 200
    assert pixels_of(both, red) > 200
    assert pixels_of(one, red) < pixels_of(both, red) / 10
    assert np.ptp(both[-150:], axis=-1).max() < 200  # the contact sheet lies below, grey but for the titles
    assert both[-150:].std() > 20


def test_at_most_sixteen_planes_of_a_part_are_drawn(make_sweep):
    sweep = make_sweep(200)
    axes = Figure().add_subplot(projection="3d")
    _draw_planes(axes, Dataset("many", sweep, sweep.select(range(20))), 20.0, 30.0)
    legend = axes.get_legend()
    assert [text.get_text() for text in legend.get_texts()] == [
        "training: 16 of 200 planes",
        "held out: 16 of 20 planes",
    ]
    outlines = np.array(axes.get_lines()[1].get_data_3d())  # [3, 16 * 6]
    assert outlines.shape[1] == 16 * 6
    y_mm = outlines[1, ::6]
    assert (y_mm[0], y_mm[-1]) == (0.0, 199.0)
    assert set(np.diff(y_mm)) == {13.0, 14.0}

"""localize(): frames of a scene are found again from a start that is off, and what cannot be found is told."""

import math
from dataclasses import astuple, replace

import numpy as np
import pytest
import torch

from ultragray import ConvexProbe, LinearProbe, localize, render
from ultragray.errors import InvalidArgument, InvalidPose
from ultragray.geometry.pose import pose_from_position_quaternion
from ultragray.geometry.rotations import turns_of
from ultragray.learn.localization import search
from ultragray.learn.localization.appearance import Motions, displacements
from ultragray.learn.localization.search import Tracker, _deviations
from ultragray.learn.localization.settings import SearchKind
from ultragray.learn.sweep import pixel_positions_mm
from ultragray.phantom import PHANTOM_PROBE, freehand_poses, simulate
from ultragray.phantom.demo import demo_poses, load_demo_scene
from ultragray.rendering.limits import UNLIMITED

SIDE = 128
FOUND_MM, FOUND_DEG = 0.5, 1.0


@pytest.fixture(scope="module")
def demo():
    return load_demo_scene()


def frame_of(scene, pose, probe=None):  # [SIDE, SIDE]
    frame = render(scene, probe, pose, height=SIDE, width=SIDE, outputs=("bmode",))["bmode"][0].detach()
    return np.asarray(frame.numpy())


def displaced(pose, probe, shift_mm, turn_deg, seed):
    motions, rng = Motions.of(probe), np.random.default_rng(seed)
    shift, axis = rng.normal(size=3), rng.normal(size=3)
    turn = math.radians(turn_deg) * motions.lever_mm * axis / np.linalg.norm(axis)
    step = np.concatenate([shift_mm * shift / np.linalg.norm(shift), turn])
    return np.asarray(motions.moved(torch.from_numpy(pose), torch.from_numpy(step)).numpy())


def distance(one, other, probe):  # mm, degrees
    return Motions.of(probe).step_between(torch.from_numpy(one), torch.from_numpy(other))


def is_found(one, other, probe):
    shift_mm, turn_deg = distance(one, other, probe)
    return shift_mm < FOUND_MM and turn_deg < FOUND_DEG


def test_frames_of_a_scene_are_found_from_3_mm_and_5_degrees_away(demo):
    probe = demo.info.probe_or(None)
    for seed, pose in enumerate(demo_poses(3)):
        start = displaced(pose, probe, 3.0, 5.0, seed)
        assert distance(start, pose, probe) == pytest.approx((3.0, 5.0), abs=1e-6)
        found = localize(demo, frame_of(demo, pose), start)
        assert found.is_found
        assert is_found(found.pose, pose, probe), seed
        assert (found.shift_mm, found.turn_deg) == pytest.approx(distance(start, found.pose, probe))


def test_a_search_that_is_repeated_tells_the_same_to_the_last_bit(demo):
    probe, pose = demo.info.probe_or(None), demo_poses(3)[1]
    image, start = frame_of(demo, pose), displaced(pose, probe, 2.0, 3.0, 0)
    first, *others = (astuple(localize(demo, image, start)) for _ in range(4))
    for other in others:
        np.testing.assert_equal(other, first)


@pytest.mark.long
def test_frames_that_the_scene_was_not_trained_from_are_found(demo):
    """Of the phantom's own image formation, with speckle that the scene has never seen."""
    poses = freehand_poses(24, tilt_deg=5.0, offset_mm=1.0, unrest=3.0)[3:22:3]
    images = simulate(poses, probe=PHANTOM_PROBE, height=SIDE, width=SIDE)
    found = [
        is_found(localize(demo, image, displaced(pose, PHANTOM_PROBE, 3.0, 5.0, seed)).pose, pose, PHANTOM_PROBE)
        for seed, (image, pose) in enumerate(zip(images, poses, strict=True))
    ]
    assert sum(found) >= len(found) - 1


def test_gain_contrast_and_noise_do_not_matter(demo):
    probe, pose = demo.info.probe_or(None), demo_poses(3)[1]
    noise = np.random.default_rng(0).normal(scale=0.02, size=(SIDE, SIDE))
    image = np.clip(0.6 * frame_of(demo, pose) ** 0.8 + 0.1 + noise, 0.0, 1.0)
    found = localize(demo, np.rint(255.0 * image).astype(np.uint8), displaced(pose, probe, 2.0, 3.0, 0))
    assert is_found(found.pose, pose, probe)


def test_a_frame_of_a_convex_probe_is_found(demo):
    probe = ConvexProbe(opening_angle_deg=60.0, near_mm=40.0, far_mm=95.0)
    pose = demo_poses(3)[1].copy()
    pose[:3, 3] -= 40.0 * pose[:3, 2]  # its face is where that of the demo's probe was
    found = localize(demo, frame_of(demo, pose, probe), displaced(pose, probe, 2.0, 3.0, 1), probe=probe)
    assert found.is_found
    assert is_found(found.pose, pose, probe)


def test_a_less_certain_start_is_looked_around_in(demo):
    probe, pose = demo.info.probe_or(None), demo_poses(3)[1]
    start = displaced(pose, probe, 8.0, 12.0, 2)
    found = localize(demo, frame_of(demo, pose), start, within_mm=9.0, within_deg=13.0)
    assert is_found(found.pose, pose, probe)


def test_frames_of_a_probe_in_motion_are_tracked(demo, monkeypatch):
    """Each from the frame before, by fewer frames than a search; and a tracker that lost its place finds it again."""
    probe, views = demo.info.probe_or(None), demo.training_poses[100:105]
    asked = []
    monkeypatch.setattr(search, "localize", lambda *a, **k: asked.append(k["search"]) or localize(*a, **k))
    tracker = Tracker(demo, views[0])
    assert all(is_found(tracker.locate(frame_of(demo, pose)).pose, pose, probe) for pose in views)
    assert asked == [SearchKind.NEAR] + [SearchKind.TRACK] * 4
    elsewhere = max(demo.training_poses, key=lambda pose: distance(views[-1], pose, probe)[0])
    again_mm, _ = distance(tracker.locate(frame_of(demo, elsewhere)).pose, elsewhere, probe)
    assert again_mm < 3.0
    assert distance(views[-1], elsewhere, probe)[0] > 15.0
    assert asked[5:] == [SearchKind.TRACK, SearchKind.NEAR, SearchKind.ANYWHERE]


def test_frames_after_lost_ones_are_found_where_they_are(demo):
    """The probe goes on meanwhile: about its last place, another is like enough to be taken for the frame's."""
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, 1, 3] = -20.0 + 1.5 * np.arange(8)
    poses[:, 0, 3] = 2.0 * np.sin(poses[:, 1, 3] / 5.0)
    tracker = Tracker(demo, poses[0])
    for number, pose in enumerate(poses):
        is_lost = number in (4, 5)
        found = tracker.locate(BLACK if is_lost else frame_of(demo, pose))
        assert found.is_found is not is_lost
        assert is_lost or is_found(found.pose, pose, demo.info.probe), number


def test_a_frame_is_found_from_nowhere(demo):
    """Beside the path: none of the poses of the index is the frame's."""
    probe = demo.info.probe_or(None)
    for seed, number in enumerate((15, 190)):
        pose = displaced(demo.training_poses[number], probe, 3.0, 4.0, seed)
        found = localize(demo, frame_of(demo, pose), search=SearchKind.ANYWHERE)
        assert found.is_found
        assert is_found(found.pose, pose, probe), number


def test_a_start_is_needed_unless_a_frame_is_looked_for_anywhere(demo, random_scene):
    with pytest.raises(InvalidPose, match="start is required"):
        localize(demo, BLACK, search="track")
    with pytest.raises(InvalidArgument, match="the scene holds no training poses"):
        localize(random_scene(50, info={"probe": PHANTOM_PROBE}), BLACK, search="anywhere")
    with pytest.raises(InvalidArgument, match="search must be one of near, track, anywhere, got 'here'"):
        localize(demo, BLACK, HERE, search="here")


def test_another_image_is_not_found(demo):
    noise = np.random.default_rng(0).random((SIDE, SIDE))
    assert not localize(demo, noise, demo_poses(3)[1]).is_found


@pytest.mark.long
def test_errors_are_as_large_as_they_are_told_to_be(demo):
    """Of frames with speckle that the scene has never seen: two of three within one deviation, nearly all within two.

    The errors of one frame go together, so that 40 frames are few: hence at most 97% within one.
    """
    motions, ratios = Motions.of(PHANTOM_PROBE), []
    for tilt_deg, offset_mm in ((5.0, 1.0), (-7.0, -1.5)):
        poses = freehand_poses(20, tilt_deg=tilt_deg, offset_mm=offset_mm, unrest=2.0)
        for pose, image in zip(poses, simulate(poses, probe=PHANTOM_PROBE, height=SIDE, width=SIDE), strict=True):
            found = localize(demo, image, pose)
            left = np.linalg.inv(found.pose) @ pose
            middle = motions.middle_mm.numpy()
            errors_mm = left[:3, 3] + left[:3, :3] @ middle - middle
            errors_deg = np.degrees(turns_of(left[None, :3, :3])[0])
            ratios += [*(errors_mm / found.position_std_mm), *(errors_deg / found.angle_std_deg)]
    assert 0.68 < np.mean(np.abs(ratios) < 1.0) < 0.97
    assert np.mean(np.abs(ratios) < 2.0) > 0.9


def test_deviations_are_those_of_a_known_regression():
    """Independent noise of standard deviation s: the deviation of each number is s / sqrt(sum of its squares), and
    what the scene errs comes on top.
    """
    random = np.random.default_rng(0)
    changes, left = random.normal(size=(6, 160, 120)), 0.3 * random.normal(size=(160, 120))
    expected = 0.3 / np.sqrt(np.square(changes).sum(axis=(1, 2)))
    told = _deviations(left, changes) / search.SCENE_ERROR
    assert (told / expected).tolist() == pytest.approx([1.0] * 6, abs=0.5)


BLACK, HERE = np.zeros((64, 64), np.uint8), np.eye(4)


@pytest.mark.parametrize(
    ("image", "start", "within", "error", "told"),
    [
        (
            np.zeros((64, 64, 3), np.uint8),
            HERE,
            {},
            InvalidArgument,
            r"grey values \[H, W\], .* \[64, 64, 3\]",
        ),
        (np.zeros((64, 64), np.uint16), HERE, {}, InvalidArgument, "got uint16"),
        (np.zeros((16, 64), np.uint8), HERE, {}, InvalidArgument, "32 pixels a side or more, got 16x64"),
        (np.full((64, 64), 2.0), HERE, {}, InvalidArgument, r"finite values in \[0, 1\]"),
        (np.full((64, 64), np.nan), HERE, {}, InvalidArgument, r"finite values in \[0, 1\]"),
        (BLACK, np.ones((4, 4)), {}, InvalidPose, "axis|rotation|row"),
        (BLACK, np.stack([HERE] * 2), {}, InvalidArgument, "one pose, got 2"),
        (BLACK, HERE, {"within_mm": 0.0}, InvalidArgument, "above 0 and at most"),
        (BLACK, HERE, {"within_mm": 21.0}, InvalidArgument, "above 0 and at most"),
        (BLACK, HERE, {"within_deg": float("nan")}, InvalidArgument, "above 0 and at most"),
    ],
)
def test_what_cannot_be_searched_for_is_refused(image, start, within, error, told, demo):
    with pytest.raises(error, match=told):
        localize(demo, image, start, **within)


def test_a_turn_is_about_the_middle_of_the_image():
    probe = load_demo_scene().info.probe_or(None)
    motions = Motions.of(probe)
    pose = torch.from_numpy(pose_from_position_quaternion([1.0, 2.0, 3.0], [1.0, 0.0, 0.0, 0.0]))
    turned = motions.moved(pose, torch.tensor([0.0, 0.0, 0.0, 4.0, 0.0, 0.0], dtype=torch.float64))
    shift_mm, turn_deg = motions.step_between(pose, turned)
    assert shift_mm == pytest.approx(0.0, abs=1e-9)
    assert turn_deg == pytest.approx(math.degrees(4.0 / motions.lever_mm))


ROWS, COLUMNS = 41, 21
LINEAR = LinearProbe(40.0, 0.0, 80.0)
CONVEX = ConvexProbe(60.0, 20.0, 100.0)  # as deep as the linear one
ROW_MM = 80.0 / ROWS


def test_a_motion_within_the_image_plane_moves_all_pixels_of_a_linear_probe_alike():
    aside, _, deeper = displacements(LINEAR, ROWS, COLUMNS)[:3]
    for found, row, column in ((aside, 0.0, COLUMNS / 40.0), (deeper, 1.0 / ROW_MM, 0.0)):
        expected = torch.tensor([row, column, 0.0])[:, None, None].expand(3, ROWS, COLUMNS)
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=0.0)


def test_on_a_fan_only_the_middle_line_moves_along_itself():
    deeper = displacements(CONVEX, ROWS, COLUMNS)[2]
    assert deeper[0, :, COLUMNS // 2].numpy() == pytest.approx(1.0 / ROW_MM, abs=1e-5)
    assert deeper[1, :, COLUMNS // 2].numpy() == pytest.approx(0.0, abs=1e-5)
    assert deeper[0, :, 0].max() < 0.9 / ROW_MM
    assert deeper[1, :, 0].abs().min() > 0.01


def test_a_turn_out_of_the_plane_moves_pixels_by_their_distance_from_its_axis():
    _, elevation, _, tilt, _, yaw = displacements(LINEAR, ROWS, COLUMNS)[:, 2]
    x, z = np.moveaxis(pixel_positions_mm(LINEAR, ROWS, COLUMNS).reshape(ROWS, COLUMNS, 3), -1, 0)[[0, 2]]
    lever_mm = Motions.of(LINEAR).lever_mm
    np.testing.assert_allclose(elevation, 1.0, atol=1e-6)
    np.testing.assert_allclose(tilt, -(z - 40.0) / lever_mm, atol=1e-5)
    np.testing.assert_allclose(yaw, x / lever_mm, atol=1e-5)


def test_two_frames_tell_how_a_frame_changes_by_all_six_numbers(demo):
    """Nearly as twelve of them do: where a shadow begins, or tissue ends, they differ."""
    probe, pose = demo.info.probe_or(None), demo_poses(3)[1]
    motions = Motions.of(probe)
    looked = search._Search(
        torch.from_numpy(frame_of(demo, pose)), probe, motions, search._renderer(demo, probe, "auto", UNLIMITED)
    )
    fits = [
        looked.linearised(torch.from_numpy(pose)[None], replace(search.TRACKING[0], rendered=rendered)).changes[0]
        for rendered in ((search.ELEVATION,), search.ALL)
    ]
    for one, other in zip(*fits, strict=True):
        assert one @ other / (np.linalg.norm(one) * np.linalg.norm(other)) > 0.8

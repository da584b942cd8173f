"""Modes of motion: in the scene file, as settings of frames, and what they do to frames and their confidence."""

import json
import struct

import numpy as np
import pytest
import torch

from ultragray import GaussianScene, LinearProbe, render
from ultragray.errors import InvalidArgument, SceneFileInvalid
from ultragray.rendering.frames import render_shown
from ultragray.rendering.settings import Encoding, FrameSettings
from ultragray.scene.info import SceneInfo, read_header
from ultragray.scene.modes import MOTION_KEY, Breathing, Mode, Motion, Moving

PROBE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)
SIZE = {"height": 32, "width": 24}


@pytest.fixture
def moving_scene(random_scene):
    """A scene that breathes along depth by 6 mm a unit, seen between 0 and 1, and beats sideways."""
    coefficients = np.zeros((2, 4, 4, 4, 3), np.float32)
    coefficients[0, ..., 2] = 6.0
    coefficients[1, ..., 0] = 1.0
    modes = Mode("breathing", 0.0, 1.0, unit="", surrogate="belt"), Mode("heartbeat", -1.0, 1.0)
    motion = Motion(modes, (-50.0,) * 3, (30.0,) * 3)
    still = random_scene(200)
    return GaussianScene.from_splats(
        still.splats, info=SceneInfo(probe=PROBE), training_poses=np.eye(4)[None], moving=Moving(motion, coefficients)
    )


@pytest.mark.parametrize("suffix", [".ugr", ".ugz"])
def test_modes_come_back_from_the_file(moving_scene, tmp_path, suffix):
    path = tmp_path / f"scene{suffix}"
    moving_scene.save(path)
    loaded = GaussianScene.load(path)
    assert loaded.info.motion == read_header(path).info.motion == moving_scene.info.motion
    np.testing.assert_array_equal(loaded.moving.coefficients, moving_scene.moving.coefficients)


def test_a_file_with_modes_has_the_same_bytes_every_time(moving_scene, tmp_path):
    assert len({moving_scene.to_bytes() for _ in range(16)}) == 1
    moving_scene.save(tmp_path / "scene.ugr")
    assert GaussianScene.load(tmp_path / "scene.ugr").to_bytes() == moving_scene.to_bytes()


def test_the_description_that_other_readers_know_is_that_of_a_still_scene(moving_scene):
    still = GaussianScene.from_splats(
        moving_scene.splats, info=SceneInfo(probe=PROBE), training_poses=moving_scene.training_poses
    )

    def header(data):
        (length,) = struct.unpack_from("<Q", data)
        return json.loads(data[8 : 8 + length])

    moved, plain = header(moving_scene.to_bytes()), header(still.to_bytes())
    assert moved["__metadata__"].pop(MOTION_KEY)
    assert moved == plain


def test_a_damaged_entry_is_refused_with_its_reason(moving_scene, tmp_path):
    data = moving_scene.to_bytes()
    cut = data.replace(b"coefficients", b"coefficientz")
    (tmp_path / "scene.ugr").write_bytes(cut)
    with pytest.raises(SceneFileInvalid, match="a shape and coefficients"):
        read_header(tmp_path / "scene.ugr")


def test_a_phase_moves_tissue_as_far_as_its_modes_say(moving_scene):
    pose = np.eye(4)[None]
    settings = FrameSettings(phase=(0.5, 0.0), **SIZE).resolved(moving_scene.info, Encoding.FLOAT32)
    moved = render_shown(moving_scene, settings, pose)["bmode"]
    shifted = pose.copy()
    shifted[:, 2, 3] -= 3.0
    expected = render(moving_scene, PROBE, shifted, **SIZE).bmode
    torch.testing.assert_close(moved, expected, atol=1e-4, rtol=0)
    at_rest = FrameSettings(phase=(0.0, 0.0), **SIZE).resolved(moving_scene.info, Encoding.FLOAT32)
    plain = FrameSettings(**SIZE).resolved(moving_scene.info, Encoding.FLOAT32)
    frames = [render_shown(moving_scene, one, pose)["bmode"] for one in (at_rest, plain)]
    np.testing.assert_array_equal(frames[0].numpy(), frames[1].numpy())
    assert (moved - frames[0]).abs().max() > 0.05


def test_breathing_goes_from_end_to_end_and_the_phase_it_chose_replays_the_frame(moving_scene):
    breathing = Breathing(period_s=4.0, depth=0.5)
    numbers = [breathing.phase(moving_scene.info.motion, at_s) for at_s in (0.0, 1.0, 2.0, 6.0)]
    np.testing.assert_allclose(numbers, [(0.0, 0.0), (0.25, 0.0), (0.5, 0.0), (0.5, 0.0)], atol=1e-9)
    asked = FrameSettings(breathing=breathing, **SIZE).resolved(moving_scene.info, Encoding.FLOAT32)
    breathed = asked.breathed(moving_scene.info.motion)
    again = FrameSettings(phase=breathed.phase, **SIZE).resolved(moving_scene.info, Encoding.FLOAT32)
    frames = [render_shown(moving_scene, one, np.eye(4)[None])["bmode"].numpy() for one in (breathed, again)]
    np.testing.assert_array_equal(*frames)
    with pytest.raises(InvalidArgument, match="want a phase"):
        render_shown(moving_scene, asked, np.eye(4)[None])


def test_confidence_falls_outside_the_range_that_was_seen(moving_scene):
    motion = moving_scene.info.motion
    assert motion.trust((1.0, -1.0)) == 1.0
    assert 1.0 > motion.trust((1.2, 0.0)) > motion.trust((1.5, 0.0)) > motion.trust((1.5, 2.0)) > 0.0


@pytest.mark.parametrize(
    ("asked", "reason"),
    [
        ({"phase": (0.5,)}, "one number for each mode \\(breathing, heartbeat\\), got 1"),
        ({"phase": (2.5, 0.0)}, "breathing must be within -1 and 2 .* got 2.5"),
        ({"phase": (0.5, 0.0), "breathing": Breathing()}, "one chooses the other"),
    ],
)
def test_numbers_that_its_modes_do_not_have_are_refused(moving_scene, asked, reason):
    with pytest.raises(InvalidArgument, match=reason):
        FrameSettings(**asked, **SIZE).resolved(moving_scene.info, Encoding.FLOAT32)


@pytest.mark.parametrize("asked", [{"phase": (0.5,)}, {"breathing": Breathing()}])
def test_a_still_scene_refuses_motion(asked):
    with pytest.raises(InvalidArgument, match="this one is still"):
        FrameSettings(**asked, **SIZE).resolved(SceneInfo(probe=PROBE), Encoding.FLOAT32)

"""Display settings that are drawn at random for each frame of a batch."""

from dataclasses import replace

import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.errors import InvalidArgument
from ultragray.rendering.display import AS_RENDERED, Display
from ultragray.rendering.frames import render_shown
from ultragray.rendering.settings import Encoding, FrameSettings

PROBE = LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=20.0)
VARIED = Display(gain_db_between=(-6.0, 6.0), dynamic_range_db_between=(40.0, 70.0), display_seed=3)


def poses(count):
    found = np.tile(np.eye(4), (count, 1, 1))
    found[:, 1, 3] = 0.01 * np.arange(count)
    return found


def test_each_frame_has_settings_of_its_own(random_scene):
    scene = random_scene()
    settings = FrameSettings(probe=PROBE, height=16, width=12, display=VARIED).resolved(scene.info, Encoding.FLOAT32)
    shown = render_shown(scene, settings, poses(5))["bmode"]
    for place, pose in enumerate(poses(5)):
        own = VARIED.of_frame(pose)
        assert not own.varies
        definite = render_shown(scene, replace(settings, display=own), pose[None])["bmode"]
        np.testing.assert_array_equal(shown[place], definite[0])
        alone = render_shown(scene, settings, pose[None])["bmode"]
        np.testing.assert_array_equal(shown[place], alone[0])


def test_what_is_drawn_fills_the_range_and_follows_the_seed():
    drawn = [VARIED.of_frame(pose) for pose in poses(400)]
    gains, ranges = np.array([one.gain_db for one in drawn]), np.array([one.dynamic_range_db for one in drawn])
    for values, (low, high) in ((gains, (-6.0, 6.0)), (ranges, (40.0, 70.0))):
        assert low <= values.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < values.max() <= high
    assert abs(np.corrcoef(gains, ranges)[0, 1]) < 0.2
    pose = poses(1)[0]
    assert VARIED.of_frame(pose) == VARIED.of_frame(pose * 1.0) != replace(VARIED, display_seed=4).of_frame(pose)
    only_gain = replace(VARIED, dynamic_range_db_between=()).of_frame(pose)
    assert (only_gain.gain_db, only_gain.dynamic_range_db) == (VARIED.of_frame(pose).gain_db, 60.0)
    assert AS_RENDERED.of_frame(pose) == AS_RENDERED


@pytest.mark.parametrize("between", [(1.0,), (2.0, 1.0)])
def test_two_numbers_in_order_are_asked_for(between):
    with pytest.raises(InvalidArgument, match="gain_db_between must be two numbers, the lower one first") as refused:
        Display(gain_db_between=between)
    assert refused.value.field == "gain_db_between"

"""Frames that are kept as the probe samples them, and read as pictures."""

import numpy as np
import pytest

from ultragray import ConvexProbe, LinearProbe, PhasedProbe
from ultragray.datasets import Sweep
from ultragray.learn.evaluation.side_by_side import as_picture
from ultragray_workers.helpers import PICTURE_SIDE, read_picture, write_stacks

PROBES = {
    "linear": LinearProbe(30.0, 0.0, 60.0),
    "phased": PhasedProbe(70.0, 50.0),
    "narrow": ConvexProbe(10.0, 40.0, 60.0),
}


@pytest.mark.parametrize("probe", PROBES.values(), ids=PROBES)
def test_a_picture_is_that_of_its_frame(tmp_path, probe):
    frames = np.random.default_rng(0).integers(0, 256, (3, 24, 20), dtype=np.uint8)
    floats = (frames / 255.0).astype(np.float32)
    write_stacks(tmp_path, {"bytes": frames, "floats": floats}, probe)
    sweep = Sweep(frames, np.tile(np.eye(4), (3, 1, 1)), probe, np.arange(3), "made")
    expected = as_picture(floats[2], sweep).astype(int)
    assert max(expected.shape) == PICTURE_SIDE
    for name in ("bytes", "floats"):
        picture = read_picture(tmp_path, name, 2)
        np.testing.assert_allclose(picture, expected, atol=1)
    assert read_picture(tmp_path, "bytes", 3) is None
    assert read_picture(tmp_path, "others", 0) is None


def test_there_may_be_no_frames(tmp_path):
    write_stacks(tmp_path, {"val": np.zeros((0, 24, 20), np.uint8)}, PROBES["linear"])
    assert read_picture(tmp_path, "val", 0) is None

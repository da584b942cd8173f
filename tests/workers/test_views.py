"""What helper processes tell of a comparison while they are at it."""

import json

import numpy as np
import pytest

from ultragray.phantom.demo import load_demo_scene
from ultragray_workers import views
from ultragray_workers.helpers import read_picture
from ultragray_workers.views import CLASSICAL, FRAMES_NAME, PICTURES, compare

from .jobs.conftest import store_dataset, tiny_dataset


@pytest.fixture
def told(tmp_path, monkeypatch):
    """What somebody finds who looks after each step: the frames, and how many pictures there are of each."""
    found = []
    write = views._Comparison._write

    def watched(comparison):
        write(comparison)
        frames = json.loads((tmp_path / "made" / FRAMES_NAME).read_text())
        drawn = [[read_picture(tmp_path / "made", str(i), n) is not None for n in range(6)] for i in range(len(frames))]
        found.append((frames, np.sum(drawn, axis=1).tolist()))

    monkeypatch.setattr(views._Comparison, "_write", watched)
    (tmp_path / "made").mkdir()
    store_dataset(tmp_path, "tiny")
    load_demo_scene().save(tmp_path / "scene.ugr")
    compare(str(tmp_path / "made"), str(tmp_path), "tiny", str(tmp_path / "scene.ugr"))
    return found


def test_the_first_frame_is_there_before_the_second_one_is_begun(told):
    count = len(tiny_dataset().val)
    assert len(told) == 1 + count * (1 + len(CLASSICAL))
    at_first, first = told[0], told[1]
    assert [frame["psnr_db"] for frame in at_first[0]] == [None] * count
    assert first[1] == [3, *[0] * (count - 1)]
    assert first[0][0]["psnr_db"] > 0
    assert first[0][0]["nearest_psnr_db"] is None
    frames, drawn = told[-1]
    assert drawn == [len(PICTURES)] * count
    assert all(value is not None for frame in frames for name, value in frame.items() if name != "confidence")

"""The picture of a dataset shows its planes and its frames."""

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from ultragray import ConvexProbe, LinearProbe, PhasedProbe
from ultragray.datasets import Dataset
from ultragray.datasets.pictures import _draw_planes, draw_dataset


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


def test_a_picture_that_fails_leaves_nothing(make_sweep, tmp_path):
    sweep = make_sweep(3)
    with pytest.raises(OSError, match="missing"):
        draw_dataset(Dataset("one", sweep, sweep.select([])), tmp_path / "missing" / "one.png")
    assert list(tmp_path.iterdir()) == []

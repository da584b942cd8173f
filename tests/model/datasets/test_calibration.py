"""Poses from calibrated images: Gram–Schmidt, scales, the origin at the top centre of the crop."""

from pathlib import Path

import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.datasets.images import CropBox, poses_from_image_transforms
from ultragray.errors import DatasetInvalid

PATH = Path("s.mha")
CROP = CropBox(left=10, right=30, top=5, bottom=45)


def image_transform(columns, rows, third):
    transform = np.eye(4)
    transform[:3] = np.stack([columns, rows, third, (100.0, 200.0, 300.0)], axis=1)
    return transform[None]


def test_pixels_become_millimetres():
    poses, probe = poses_from_image_transforms(
        image_transform((0.2, 0, 0), (0, 0, 0.1), (0, 1, 0)), CROP, np.arange(1), PATH
    )
    assert probe == LinearProbe(width_mm=4.0, near_mm=0.0, far_mm=4.0)
    np.testing.assert_allclose(poses[0, :3, :3], np.eye(3), atol=1e-15)
    # middle of columns 10 … 29 is 19.5, the upper edge of row 5 is 4.5
    np.testing.assert_allclose(poses[0, :3, 3], (100 + 0.2 * 19.5, 200, 300 + 0.1 * 4.5))


def test_skewed_axes_keep_the_lateral_one():
    poses, probe = poses_from_image_transforms(
        image_transform((0.2, 0, 0), (0.01, 0, 0.1), (0, 0, 0.05)), CROP, np.arange(1), PATH
    )
    np.testing.assert_allclose(poses[0, :3, :3], np.eye(3), atol=1e-15)
    assert probe.far_mm == pytest.approx(40 * np.hypot(0.01, 0.1), abs=1e-8)  # the length of the column, as it is


@pytest.mark.parametrize("third", [(0, 1, 0), (0, -1, 0)])
def test_the_third_axis_of_the_image_does_not_matter(third):
    poses, _ = poses_from_image_transforms(image_transform((0, 0.2, 0), (0, 0, 0.1), third), CROP, np.arange(1), PATH)
    assert np.linalg.det(poses[0, :3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(poses[0, :3, 1], (-1, 0, 0), atol=1e-15)  # z × x


def test_images_that_are_no_plane_are_refused():
    with pytest.raises(DatasetInvalid, match=r"s\.mha: frame 4: columns and rows .* nearly parallel"):
        poses_from_image_transforms(image_transform((0.2, 0, 0), (0.1, 0, 0.01), (0, 1, 0)), CROP, np.array([4]), PATH)


def test_a_scale_that_changes_is_refused():
    usual = image_transform((0.2, 0, 0), (0, 0, 0.1), (0, 1, 0))
    other = image_transform((0.21, 0, 0), (0, 0, 0.1), (0, 1, 0))
    with pytest.raises(
        DatasetInvalid, match=r"frame 9: a pixel is 0\.21 x 0\.1 mm, in other frames \(3, 5\) 0\.2 x 0\.1"
    ):
        poses_from_image_transforms(np.concatenate([usual, usual, other]), CROP, np.array([3, 5, 9]), PATH)

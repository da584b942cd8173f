"""Stored frames as grey uint8, crops, box resizing, and poses from calibrated images."""

from pathlib import Path

import numpy as np
import pytest
from skimage.transform import resize_local_mean

from ultragray import LinearProbe
from ultragray.datasets.images import (
    CropBox,
    grey_frames,
    parse_crop,
    parse_image_size,
    poses_from_image_transforms,
    resize_frames,
)
from ultragray.errors import DatasetInvalid, InvalidArgument


def test_every_layout_becomes_grey():
    grey = np.random.default_rng(0).integers(0, 256, (3, 5, 7), dtype=np.uint8)
    for stored in (
        grey,
        grey[:, None],
        grey[..., None],
        np.repeat(grey[..., None], 3, axis=-1),
        np.concatenate([np.repeat(grey[..., None], 3, axis=-1), np.full((3, 5, 7, 1), 9, np.uint8)], axis=-1),
        (grey / 255.0).astype(np.float32),
        (grey / 255.0)[:, None],
    ):
        np.testing.assert_array_equal(grey_frames(stored, "file"), grey)


def test_colours_become_their_luma():
    colours = np.zeros((3, 1, 2, 3), np.uint8)
    for channel in range(3):
        colours[channel, ..., channel] = 200
    assert grey_frames(colours, "file")[:, 0, 0].tolist() == [60, 117, 23]  # .299, .587, .114 of 200


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (np.zeros((2, 3), np.uint8), r"must be \[N, H, W\].*got \[2, 3\]"),
        (np.zeros((2, 3, 4, 5), np.uint8), r"got \[2, 3, 4, 5\]"),
        (np.zeros((2, 3, 4), np.int16), "got int16"),
        (np.array([0.5, np.nan]).repeat(6).reshape(2, 2, 3), "frame 1 holds NaN"),
        (np.array([0.5, 200.0]).repeat(6).reshape(2, 2, 3), "frame 1 must be uint8 or lie in .* from 200 to 200"),
        (np.array([0.5, -0.1]).repeat(6).reshape(2, 2, 3), "frame 1 must be uint8 or lie in"),
    ],
)
def test_other_images_are_refused(frames, message):
    with pytest.raises(DatasetInvalid, match=f"^file: .*{message}"):
        grey_frames(frames, "file")


def test_a_box_is_the_mean_of_what_it_covers():
    image = np.zeros((1, 4, 6), np.uint8)
    image[0, :2, 3:6] = 90
    np.testing.assert_array_equal(resize_frames(image, 2, 2), [[[0, 90], [0, 0]]])
    third = resize_frames(image, 4, 2)[0, 0]  # columns of 1.5 pixels: the edge at column 3 stays where it is
    assert third.tolist() == [0, 0, 90, 90]


@pytest.mark.parametrize("size", [(40, 30), (17, 23), (50, 7)])
def test_boxes_are_those_of_scikit_image(size):
    image = np.random.default_rng(0).integers(0, 256, (60, 50), dtype=np.uint8)
    width, height = size
    expected = resize_local_mean(image, (height, width), preserve_range=True)
    np.testing.assert_allclose(resize_frames(image[None], width, height)[0], expected, atol=0.51)  # rounded to bytes


def test_crops():
    assert parse_crop(None, 616, 820) == CropBox(0, 820, 0, 616)
    box = parse_crop("188:632, 12:600", 616, 820)
    assert box == CropBox(188, 632, 12, 600)
    assert (box.width, box.height) == (444, 588)
    assert parse_crop(":10,5:", 616, 820) == CropBox(0, 10, 5, 616)


@pytest.mark.parametrize(
    "text",
    [
        *("", "1:2", "188-632,12-600", "0:821,0:616", "0:820,0:617", "5:5,0:616", "9:3,0:616"),
        f"0:5,0:{'9' * 5000}",
    ],
)
def test_crops_outside_the_image_are_refused(text):
    with pytest.raises(InvalidArgument, match=r"^crop must"):
        parse_crop(text, 616, 820)


def test_image_sizes():
    assert parse_image_size("192x256") == (192, 256)
    for text in ("192", "0x5", "5x0", "x", "99999x9", "-1x5", f"5x{'9' * 5000}"):
        with pytest.raises(InvalidArgument, match=r"^image_size must be width x height"):
            parse_image_size(text)


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

"""Settings of frames and of their display: completed for a scene, what is shown, where its pixels lie, their bytes."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from ultragray import ConvexProbe, ElevationBeam, LinearProbe, PhasedProbe, RadialProbe, SceneInfo, SteeredProbe
from ultragray.errors import InvalidArgument, InvalidImageSize
from ultragray.geometry.image_size import MAX_IMAGE_SIDE, check_image_size
from ultragray.geometry.scan_conversion import samples, scan_convert
from ultragray.rendering.display import Display
from ultragray.rendering.frames import show
from ultragray.rendering.pixels import encoded_image, in_type, to_uint8
from ultragray.rendering.settings import Encoding, FrameSettings

LINEAR = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)
CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=40.0, far_mm=100.0)
PHASED = PhasedProbe(opening_angle_deg=90.0, far_mm=80.0)
PROBES = (LINEAR, CONVEX, PHASED)
HEIGHT, WIDTH = 40, 30


def frames(seed=0):
    generator = torch.Generator().manual_seed(seed)
    names = ("bmode", "echo")
    return {name: torch.rand((2, HEIGHT, WIDTH), generator=generator) for name in names} | {
        "labels": torch.randint(0, 5, (2, HEIGHT, WIDTH), generator=generator, dtype=torch.uint8)
    }


@pytest.mark.parametrize("probe", PROBES, ids=lambda probe: probe.kind)
def test_the_defaults_show_frames_as_they_are(probe):
    given = frames()
    shown = show(given, probe, Display())
    assert {name: torch.equal(shown[name], given[name]) for name in given} == dict.fromkeys(given, True)
    picture = Display().picture(probe, HEIGHT, WIDTH)
    assert (picture.height, picture.width) == (HEIGHT, WIDTH)


def test_grey_levels_follow_their_definition():
    display = Display(gain_db=6.0, dynamic_range_db=40.0, tgc_db=(0.0, -10.0, 20.0))
    bmode = frames()["bmode"]
    shown = show({"bmode": bmode, "echo": bmode}, LINEAR, display)
    depth = (np.arange(HEIGHT) + 0.5) / HEIGHT
    tgc = np.where(depth < 0.5, -20.0 * depth, -10.0 + 60.0 * (depth - 0.5))
    level_db = 60.0 * (bmode.double().numpy() - 1.0) + 6.0 + tgc[:, None]
    np.testing.assert_allclose(shown["bmode"].numpy(), np.clip(1.0 + level_db / 40.0, 0.0, 1.0), atol=1e-6)
    assert torch.equal(shown["echo"], bmode)


@pytest.mark.parametrize(("probe", "rows"), [(LINEAR, 16), (CONVEX, 13), (PHASED, 10)], ids=lambda value: str(value))
def test_depth_counts_from_the_face(probe, rows):
    display = Display(depth_mm=20.0)
    given = frames()
    shown = show(given, probe, display)
    assert torch.equal(shown["echo"], given["echo"][:, :rows])
    assert display.picture(probe, HEIGHT, WIDTH).height == rows


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("probe", PROBES, ids=lambda probe: probe.kind)
def test_pixels_of_a_picture_lie_where_it_says(probe, flip):
    """A frame whose values are positions shows at each pixel the position that its picture tells."""
    display = Display(flip=flip, pixel_mm=1.3, depth_mm=45.0)
    origins, directions = probe.scan_lines(WIDTH)
    depths = probe.depths_mm(HEIGHT)
    positions = origins[None] + depths[:, None, None] * directions[None]  # [H, W, 3] mm
    given = {
        "echo": torch.from_numpy(positions[None, :, :, 0]).float(),
        "transmittance": torch.from_numpy(positions[None, :, :, 2]).float(),
        "coverage": torch.ones((1, HEIGHT, WIDTH)),
    }
    x_shown, z_shown, inside = (pixels[0].numpy() for pixels in show(given, probe, display).values())
    picture = display.picture(probe, HEIGHT, WIDTH)
    assert x_shown.shape == (picture.height, picture.width)
    x, z = picture.positions_mm()
    # Away from the border, where the nearest sample is shown
    eroded = np.stack([np.roll(inside, (i, j), (0, 1)) for i in (-3, 0, 3) for j in (-3, 0, 3)]).min(0) > 0
    eroded[:3] = eroded[-3:] = eroded[:, :3] = eroded[:, -3:] = False
    assert eroded.sum() > 50
    np.testing.assert_allclose(x_shown[eroded], np.broadcast_to(x, eroded.shape)[eroded], atol=0.05)
    np.testing.assert_allclose(z_shown[eroded], np.broadcast_to(z, eroded.shape)[eroded], atol=0.05)


@pytest.mark.parametrize(
    "probe", [CONVEX, RadialProbe(2.0, 20.0), SteeredProbe(30.0, 20.0, 0.0, 40.0)], ids=lambda probe: probe.kind
)
def test_frames_are_scan_converted_as_arrays_are(probe):
    given = frames()
    shown = show(given, probe, Display(pixel_mm=0.8))
    for k in range(2):
        expected = scan_convert(given["bmode"][k].numpy(), probe, 0.8)
        np.testing.assert_allclose(shown["bmode"][k].numpy(), expected, atol=2e-5)
    labels = given["labels"][0].numpy()  # are not mixed: each pixel has that of the nearest sample
    rows, columns, inside = samples(probe, labels.shape, 0.8)
    nearest = labels[np.rint(rows).astype(int), np.rint(columns).astype(int) % labels.shape[1]]
    assert (shown["labels"][0].numpy() == nearest * inside).mean() > 0.999  # samples half-way between two


@pytest.mark.parametrize(
    ("field", "settings"),
    [
        ("gain_db", {"gain_db": 1000.0}),
        ("gain_db", {"gain_db": float("nan")}),
        ("dynamic_range_db", {"dynamic_range_db": 0.0}),
        ("tgc_db", {"tgc_db": (0.0,) * 17}),
        ("tgc_db[1]", {"tgc_db": (0.0, 1e9)}),
        ("depth_mm", {"depth_mm": 0.0}),
        ("pixel_mm", {"pixel_mm": -1.0}),
    ],
)
def test_settings_beyond_their_limits_are_refused(field, settings):
    with pytest.raises(InvalidArgument) as refusal:
        Display(**settings)
    assert refusal.value.field == field


def test_a_huge_picture_is_refused():
    with pytest.raises(InvalidImageSize, match=r"pixels of 0\.001 mm"):
        Display(pixel_mm=0.001).picture(CONVEX, HEIGHT, WIDTH)


def test_edge_enhancement_raises_the_bright_side_of_an_edge_and_lowers_the_dark_one():
    step = torch.full((1, 9, 12), 0.4)
    step[..., 6:] = 0.6
    shown = show({"bmode": step, "echo": step}, LINEAR, Display(edge=1.0))
    assert torch.equal(shown["echo"], step)
    bmode = shown["bmode"]
    flat = torch.ones(12, dtype=torch.bool)
    flat[5:7] = False
    torch.testing.assert_close(bmode[..., flat], step[..., flat])
    torch.testing.assert_close(bmode[..., 5], torch.full((1, 9), 0.4 - 0.2 / 3))
    torch.testing.assert_close(bmode[..., 6], torch.full((1, 9), 0.6 + 0.2 / 3))


def test_uint8_saturates_and_rounds():
    frame = np.array([[[0.0, 0.4 / 255, 0.6 / 255, 127.4 / 255, 1.0, 2.0]]], np.float32)
    before = frame.copy()
    np.testing.assert_array_equal(to_uint8(frame), [[[0, 0, 1, 127, 255, 255]]])
    np.testing.assert_array_equal(frame, before)


def test_pixels_are_little_endian_and_contiguous():
    frames = np.arange(12, dtype=np.float32).reshape(2, 2, 3)[:, :, ::2]
    assert in_type(frames, Encoding.FLOAT32.pixel_type).data.cast("B")[4:8].tobytes() == np.float32(2).tobytes()
    assert in_type(frames, Encoding.UINT8.pixel_type).tolist() == [[[0, 255], [255, 255]], [[255, 255], [255, 255]]]


def test_bytes_are_taken_as_they_are():
    """A GPU has rounded them already, or they are labels."""
    frame = np.array([[0, 1], [254, 255]], np.uint8)
    assert in_type(frame[None], Encoding.UINT8.pixel_type).tolist() == [frame.tolist()]
    floats = in_type(frame[None], Encoding.FLOAT32.pixel_type)
    assert (floats.dtype.str, floats.tolist()) == ("<f4", [frame.tolist()])
    assert decoded(encoded_image(frame, Encoding.PNG)).tolist() == frame.tolist()


def decoded(file):
    return cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (96, 128)], ids=str)
def test_a_png_file_holds_every_pixel(size):
    frame = np.random.default_rng(0).integers(0, 256, size, dtype=np.uint8)
    np.testing.assert_array_equal(decoded(encoded_image(frame, Encoding.PNG)), frame)


def test_what_is_no_image_file_is_refused():
    with pytest.raises(ValueError, match="uint8 is no image file"):
        encoded_image(np.zeros((2, 2), np.uint8), Encoding.UINT8)


FOCUSED = ElevationBeam(thickness_mm=2.0, focus_mm=30.0, depth_of_field_mm=20.0)
PLANE = ElevationBeam(thickness_mm=0.0)


def resolved(beam, thickness_mm):
    info = SceneInfo(probe=LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0), beam=beam)
    return FrameSettings(slice_thickness_mm=thickness_mm).resolved(info, Encoding.UINT8)


@pytest.mark.parametrize(
    ("beam", "thickness_mm", "used"),
    [
        (None, None, PLANE),
        (None, 0.0, PLANE),
        (None, 3.0, ElevationBeam(thickness_mm=3.0)),
        (FOCUSED, None, FOCUSED),
        (FOCUSED, 0.0, replace(FOCUSED, thickness_mm=0.0)),
        (FOCUSED, 3.0, ElevationBeam(thickness_mm=3.0, focus_mm=30.0, depth_of_field_mm=20.0)),
    ],
)
def test_a_slice_has_the_shape_of_the_scenes_beam(beam, thickness_mm, used):
    found = resolved(beam, thickness_mm)
    assert found.beam == used
    assert resolved(beam, found.beam.thickness_mm).beam == used  # what a frame tells renders it again


def test_frames_of_different_thickness_are_not_rendered_together():
    assert resolved(FOCUSED, None).view == resolved(FOCUSED, 2.0).view
    assert resolved(FOCUSED, None).view != resolved(FOCUSED, 2.5).view


@pytest.mark.parametrize("thickness_mm", [-0.1, 100.1, float("nan")])
def test_a_thickness_has_limits(thickness_mm):
    with pytest.raises(InvalidArgument, match="slice_thickness_mm must be a finite number from 0 to 100"):
        FrameSettings(slice_thickness_mm=thickness_mm)


@pytest.mark.parametrize("side", [1, 512, MAX_IMAGE_SIDE, np.int64(7)])
def test_sizes_within_the_limit(side):
    check_image_size(side, 1)
    check_image_size(1, side)


@pytest.mark.parametrize("side", [0, -1, MAX_IMAGE_SIDE + 1, 1.0, "512", None, True, float("nan")])
@pytest.mark.parametrize("field", ["height", "width"])
def test_other_sizes_are_refused_by_name(side, field):
    with pytest.raises(InvalidImageSize, match=f"^{field} must be an integer from 1 to {MAX_IMAGE_SIDE}") as caught:
        check_image_size(**{"height": 8, "width": 8, field: side})
    assert caught.value.field == field


def test_a_service_may_set_a_lower_limit():
    with pytest.raises(InvalidImageSize, match="from 1 to 100"):
        check_image_size(101, 8, limit=100)

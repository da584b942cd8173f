"""Settings of frames, completed for a scene; image sizes."""

from dataclasses import replace

import numpy as np
import pytest

from ultragray import ElevationBeam, LinearProbe, SceneInfo
from ultragray.errors import InvalidArgument, InvalidImageSize
from ultragray.geometry.image_size import MAX_IMAGE_SIDE, check_image_size
from ultragray.rendering.settings import Encoding, FrameSettings

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

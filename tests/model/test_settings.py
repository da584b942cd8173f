"""Settings of frames, completed for a scene: how thick their slice is."""

from __future__ import annotations

from dataclasses import replace

import pytest

from ultragray import ElevationBeam, LinearProbe, SceneInfo
from ultragray.errors import InvalidArgument
from ultragray.rendering.settings import Encoding, FrameSettings, Resolved

FOCUSED = ElevationBeam(thickness_mm=2.0, focus_mm=30.0, depth_of_field_mm=20.0)
PLANE = ElevationBeam(thickness_mm=0.0)


def resolved(beam: ElevationBeam | None, thickness_mm: float | None) -> Resolved:
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
def test_a_slice_has_the_shape_of_the_scenes_beam(
    beam: ElevationBeam | None, thickness_mm: float | None, used: ElevationBeam
) -> None:
    found = resolved(beam, thickness_mm)
    assert found.beam == used
    assert resolved(beam, found.beam.thickness_mm).beam == used  # what a frame tells renders it again


def test_frames_of_different_thickness_are_not_rendered_together() -> None:
    assert resolved(FOCUSED, None).view == resolved(FOCUSED, 2.0).view
    assert resolved(FOCUSED, None).view != resolved(FOCUSED, 2.5).view


@pytest.mark.parametrize("thickness_mm", [-0.1, 100.1, float("nan")])
def test_a_thickness_has_limits(thickness_mm: float) -> None:
    with pytest.raises(InvalidArgument, match="slice_thickness_mm must be a finite number from 0 to 100"):
        FrameSettings(slice_thickness_mm=thickness_mm)

"""Where pixels lie."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ultragray_client import ConvexProbe, Display, Picture, Placement, Quaternion, RenderSettings, errors

from ..service.conftest import DEMO_PROBE, HEIGHT, WIDTH

FAN = ConvexProbe(opening_angle_deg=50.0, near_mm=20.0, far_mm=60.0)
TILTED = Placement((1.0, 2.0, 3.0), Quaternion(w=0.8, x=0.36, y=0.48, z=0.0))


def test_pixels_lie_where_the_probe_says(client: Any) -> None:
    """The corners of a linear image, half a pixel from the probe's; k leaves the plane against elevation."""
    frame = client.render("demo", TILTED)
    column_mm, row_mm = DEMO_PROBE.width_mm / WIDTH, DEMO_PROBE.far_mm / HEIGHT
    corners = np.array([[0, 0, 0, 1], [WIDTH - 1, 0, 0, 1], [0, HEIGHT - 1, 0, 1], [0, 0, 5, 1]], dtype=float)
    x = (DEMO_PROBE.width_mm - column_mm) / 2
    in_probe = [[-x, 0, row_mm / 2, 1], [x, 0, row_mm / 2, 1], [-x, 0, 40 - row_mm / 2, 1], [-x, -5, row_mm / 2, 1]]
    matrix = frame.pixel_to_scene()
    np.testing.assert_allclose(corners @ matrix.T, np.array(in_probe) @ frame.pose.T, atol=1e-9)
    assert np.linalg.det(matrix[:3, :3]) > 0


def test_a_fan_has_a_matrix_once_its_pixels_are_square(client: Any) -> None:
    polar = client.render("demo", np.eye(4), RenderSettings(probe=FAN))
    assert polar.picture.column_unit == "deg"
    with pytest.raises(errors.InvalidArgument, match="pixel_mm") as caught:
        polar.pixel_to_scene()
    assert caught.value.field == "display.pixel_mm"
    frame = client.render(
        "demo", np.eye(4), RenderSettings(probe=FAN, display=Display(pixel_mm=0.5, flip=True), outputs=("coverage",))
    )
    height, width = frame["coverage"].shape
    top_left = frame.pixel_to_scene() @ [0, 0, 0, 1]
    half_angle = np.radians(25.0)
    np.testing.assert_allclose(top_left[:3], [(width - 1) * 0.25, 0.0, 20.0 * np.cos(half_angle) + 0.25], atol=1e-9)
    assert frame.picture == Picture("mm", top_left[0], top_left[2], -0.5, 0.5)
    assert height == np.ceil((60.0 - 20.0 * np.cos(half_angle)) / 0.5)

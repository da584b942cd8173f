"""Display settings, and where pixels lie."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ultragray import ConvexProbe as LibraryConvexProbe
from ultragray import GaussianScene, render
from ultragray.rendering.display import AS_RENDERED
from ultragray.rendering.display import Display as LibraryDisplay
from ultragray.rendering.frames import show
from ultragray_client import ConvexProbe, Display, Encoding, Picture, Placement, Quaternion, RenderSettings, errors

from ..service.conftest import DEMO_PROBE, HEIGHT, WIDTH

FAN = ConvexProbe(opening_angle_deg=50.0, near_mm=20.0, far_mm=60.0)
LIBRARY_FAN = LibraryConvexProbe(50.0, 20.0, 60.0)
DISPLAY = Display(gain_db=6.0, dynamic_range_db=50.0, tgc_db=(0.0, 3.0), depth_mm=25.0, flip=True, pixel_mm=0.9)
TILTED = Placement((1.0, 2.0, 3.0), Quaternion(w=0.8, x=0.36, y=0.48, z=0.0))


def test_a_frame_is_shown_as_the_library_shows_it(client: Any, demo_scene: GaussianScene) -> None:
    frame = client.render("demo", TILTED, RenderSettings(probe=FAN, display=DISPLAY, encoding=Encoding.FLOAT32))
    rendered = render(demo_scene, LIBRARY_FAN, frame.pose, height=HEIGHT, width=WIDTH).bmode
    assert rendered is not None
    expected = show({"bmode": rendered}, LIBRARY_FAN, LibraryDisplay(**vars(DISPLAY)))["bmode"][0].numpy()
    np.testing.assert_allclose(frame["bmode"], expected, atol=1e-5)
    assert (frame.display, frame.rendered_height, frame.rendered_width) == (DISPLAY, HEIGHT, WIDTH)
    again = client.render(
        frame.scene,
        frame.pose,
        RenderSettings(
            probe=frame.probe,
            display=frame.display,
            encoding=Encoding.FLOAT32,
            height=frame.rendered_height,
            width=frame.rendered_width,
        ),
    )
    np.testing.assert_array_equal(again["bmode"], frame["bmode"])


def test_every_way_takes_them(client: Any) -> None:
    wanted = client.render("demo", np.eye(4), RenderSettings(display=DISPLAY))["bmode"]
    (of_batch,) = client.render_batch("demo", [np.eye(4)], RenderSettings(display=DISPLAY))
    with client.stream("demo", RenderSettings(display=DISPLAY)) as stream:
        stream.send(np.eye(4))
        of_stream = stream.receive()
    for frame in (of_batch, of_stream):
        np.testing.assert_array_equal(frame["bmode"], wanted)
        assert frame.display == DISPLAY


def test_defaults_are_those_of_the_service(client: Any) -> None:
    assert vars(Display()) == vars(AS_RENDERED)
    assert client.render("demo", np.eye(4)).display == Display()
    assert client.render("demo", np.eye(4), RenderSettings(display=Display(flip=True))).display == Display(flip=True)


def test_refusals_name_the_setting(client: Any) -> None:
    with pytest.raises(errors.InvalidArgument) as caught:
        client.render("demo", np.eye(4), RenderSettings(display=Display(tgc_db=(0.0, 1e6))))
    assert caught.value.field == "settings.display.tgc_db[1]"
    with pytest.raises(errors.InvalidImageSize):
        client.render("demo", np.eye(4), RenderSettings(display=Display(pixel_mm=0.001)))


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

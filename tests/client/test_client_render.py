"""The package, frames one by one and in batches, and where their pixels lie."""

import inspect
import subprocess
import sys

import numpy as np
import pytest

import ultragray_client
from ultragray import render
from ultragray_client import (
    AsyncClient,
    Client,
    ConvexProbe,
    Display,
    Encoding,
    LinearProbe,
    Picture,
    Placement,
    Quaternion,
    RenderSettings,
    errors,
)

from ..service.conftest import DEMO_PROBE, HEIGHT, WIDTH
from .conftest import MAX_POSES


def test_an_import_takes_no_more_than_it_needs():
    program = "import sys, ultragray_client; print(*{name.split('.')[0] for name in sys.modules})"
    told = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout
    assert {"ultragray_client", "ultragray_proto", "grpc", "numpy"} <= set(told.split())
    assert not {"torch", "ultragray", "ultragray_service", "ultragray_workers", "pydantic"} & set(told.split())


def test_exported_names_exist():
    assert len(set(ultragray_client.__all__)) == len(ultragray_client.__all__)
    for name in ultragray_client.__all__:
        assert hasattr(ultragray_client, name)


def moved(x_mm):
    pose = np.eye(4)
    pose[0, 3] = x_mm
    return pose


@pytest.mark.parametrize(("encoding", "within"), [(Encoding.FLOAT32, 1e-5), (Encoding.FLOAT16, 6e-4)])
def test_a_frame_is_what_the_library_renders(client, demo_scene, encoding, within):
    frame = client.render("demo", moved(2.0), RenderSettings(outputs=("transmittance", "bmode"), encoding=encoding))
    expected = render(demo_scene, None, moved(2.0), height=HEIGHT, width=WIDTH, outputs=("bmode", "transmittance"))
    assert list(frame.arrays) == ["transmittance", "bmode"]
    for name in ("transmittance", "bmode"):
        assert frame[name].dtype == np.dtype(encoding.value)
        assert not frame[name].flags.writeable
        np.testing.assert_allclose(frame[name], getattr(expected, name)[0], atol=within)
    np.testing.assert_array_equal(frame.pose, moved(2.0))
    assert frame.probe == LinearProbe(DEMO_PROBE.width_mm, DEMO_PROBE.near_mm, DEMO_PROBE.far_mm)
    assert (frame.scene, len(frame.scene_sha256), frame.sequence, frame.dropped) == ("demo", 64, 0, 0)
    assert frame.renderer.startswith("ultragray/")
    assert frame.timings.render_ms > 0
    assert frame.latency_ms is None


def test_poses_and_probes_may_be_written_in_words(client):
    half = 0.5**0.5
    placement = Placement((1.0, 2.0, 3.0), Quaternion(w=half, x=0.0, y=0.0, z=half))
    probe = LinearProbe(width_mm=20.0, near_mm=1.0, far_mm=30.0)
    frame = client.render("demo", placement, RenderSettings(probe=probe, height=16, width=8))
    expected = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(frame.pose, expected, atol=1e-12)
    assert (frame.probe, frame["bmode"].shape) == (probe, (16, 8))


def given(**settings):
    return {"settings": RenderSettings(**settings)}


@pytest.mark.parametrize(
    ("arguments", "error", "field"),
    [
        ({"scene": "gone"}, errors.SceneNotFound, "settings.scene"),
        ({"pose": 2 * np.eye(4)}, errors.InvalidPose, "pose.matrix"),
        (given(probe=LinearProbe(-1, 0, 1)), errors.InvalidProbe, "settings.probe.linear.width_mm"),
        (given(encoding=Encoding.PNG), errors.InvalidArgument, "encoding"),
        ({"timeout_s": 0.0}, errors.InvalidArgument, "timeout_s"),
    ],
)
def test_refusals_have_a_type_and_a_field(client, arguments, error, field):
    with pytest.raises(error) as caught:
        client.render(**{"scene": "demo", "pose": np.eye(4), **arguments})
    assert type(caught.value) is error
    assert (caught.value.field, caught.value.reason) == (field, error.reason)
    assert caught.value.detail in str(caught.value)


def test_a_long_batch_is_split_into_calls_that_the_service_takes(client):
    shifts = np.linspace(-4, 4, 3 * MAX_POSES + 7)
    frames = list(client.render_batch("demo", (moved(x) for x in shifts), RenderSettings(height=8, width=8)))
    assert [frame.sequence for frame in frames] == list(range(len(shifts)))
    assert [frame.pose[0, 3] for frame in frames] == shifts.tolist()
    alone = client.render("demo", moved(shifts[-1]), RenderSettings(height=8, width=8))
    np.testing.assert_array_equal(frames[-1]["bmode"], alone["bmode"])


def test_a_batch_takes_poses_as_it_goes(client):
    taken = 0

    def endless():
        nonlocal taken
        while True:
            taken += 1
            yield np.eye(4)

    batch = client.render_batch("demo", endless(), RenderSettings(height=8, width=8))
    for _ in range(10):
        next(batch)
    assert taken < 1000
    assert not list(client.render_batch("demo", []))


def test_both_clients_have_the_same_methods():
    def signatures(cls):
        public = inspect.getmembers(cls, lambda value: inspect.isfunction(value))
        return {
            name: [(parameter.name, parameter.default) for parameter in inspect.signature(method).parameters.values()]
            for name, method in public
            if not name.startswith("_")
        }

    assert signatures(Client) == signatures(AsyncClient)


FAN = ConvexProbe(opening_angle_deg=50.0, near_mm=20.0, far_mm=60.0)
TILTED = Placement((1.0, 2.0, 3.0), Quaternion(w=0.8, x=0.36, y=0.48, z=0.0))


def test_pixels_lie_where_the_probe_says(client):
    """The corners of a linear image, half a pixel from the probe's; k leaves the plane against elevation."""
    frame = client.render("demo", TILTED)
    column_mm, row_mm = DEMO_PROBE.width_mm / WIDTH, DEMO_PROBE.far_mm / HEIGHT
    corners = np.array([[0, 0, 0, 1], [WIDTH - 1, 0, 0, 1], [0, HEIGHT - 1, 0, 1], [0, 0, 5, 1]], dtype=float)
    x = (DEMO_PROBE.width_mm - column_mm) / 2
    in_probe = [[-x, 0, row_mm / 2, 1], [x, 0, row_mm / 2, 1], [-x, 0, 40 - row_mm / 2, 1], [-x, -5, row_mm / 2, 1]]
    matrix = frame.pixel_to_scene()
    np.testing.assert_allclose(corners @ matrix.T, np.array(in_probe) @ frame.pose.T, atol=1e-9)
    assert np.linalg.det(matrix[:3, :3]) > 0


def test_a_fan_has_a_matrix_once_its_pixels_are_square(client):
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

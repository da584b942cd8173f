"""Display settings through each front door."""

from __future__ import annotations

import json
from typing import Any

import httpx
import numpy as np
import pytest
from websockets.sync.client import connect

from ultragray import ConvexProbe, GaussianScene, render
from ultragray.contract import to_dict
from ultragray.rendering.display import Display
from ultragray.rendering.frames import show
from ultragray_proto.v1 import geometry_pb2, rendering_pb2

from .conftest import DEMO_PROBE, HEIGHT, WIDTH, RunningService

FAN = ConvexProbe(opening_angle_deg=50.0, near_mm=20.0, far_mm=60.0)
DISPLAY = Display(gain_db=6.0, dynamic_range_db=50.0, tgc_db=(0.0, 3.0), depth_mm=25.0, flip=True, pixel_mm=0.9)
BODY = {
    "gain_db": 6.0,
    "dynamic_range_db": 50.0,
    "tgc_db": [0.0, 3.0],
    "depth_mm": 25.0,
    "flip": True,
    "pixel_mm": 0.9,
}
FAN_BODY = {"kind": "convex", "opening_angle_deg": 50.0, "near_mm": 20.0, "far_mm": 60.0}
POSE_BODY = {"matrix": np.eye(4).tolist()}


@pytest.fixture(scope="module")
def expected(demo_scene: GaussianScene) -> Any:  # [2, H', W']
    frames = render(demo_scene, FAN, np.eye(4), height=HEIGHT, width=WIDTH, outputs=("bmode", "coverage"))
    assert frames.bmode is not None
    assert frames.coverage is not None
    shown = show({"bmode": frames.bmode, "coverage": frames.coverage}, FAN, DISPLAY)
    return np.stack([shown[name][0].numpy() for name in ("bmode", "coverage")])


def settings(**fields: Any) -> rendering_pb2.RenderSettings:
    fan = geometry_pb2.ConvexProbe(opening_angle_deg=50.0, near_mm=20.0, far_mm=60.0)
    given = {"scene": "demo", "probe": geometry_pb2.Probe(convex=fan), "display": rendering_pb2.Display(**BODY)}
    return rendering_pb2.RenderSettings(**{**given, **fields})


def request(**fields: Any) -> rendering_pb2.RenderRequest:
    identity = geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=np.eye(4).ravel().tolist()))
    return rendering_pb2.RenderRequest(settings=settings(**fields), pose=identity)


def test_grpc(renders: Any, expected: Any) -> None:
    outputs = [rendering_pb2.OUTPUT_BMODE, rendering_pb2.OUTPUT_COVERAGE]
    frame = renders.Render(request(outputs=outputs, encoding=rendering_pb2.ENCODING_FLOAT32))
    pixels = np.frombuffer(frame.data, "<f4").reshape(2, frame.height, frame.width)
    np.testing.assert_allclose(pixels, expected, atol=1e-5)
    assert (frame.rendered_height, frame.rendered_width) == (HEIGHT, WIDTH)
    picture = DISPLAY.picture(FAN, HEIGHT, WIDTH)
    told = frame.picture
    assert (told.first_column, told.first_row_mm) == picture.first
    assert (told.column_step, told.row_step_mm) == picture.step == (-0.9, 0.9)
    assert told.column_unit == "mm"
    assert frame.display == rendering_pb2.Display(**BODY)


def test_grpc_without_display_settings(renders: Any) -> None:
    frame = renders.Render(request(display=None, probe=None))
    assert not frame.HasField("display")
    assert (frame.height, frame.width) == (HEIGHT, WIDTH)
    assert frame.picture.column_step == pytest.approx(DEMO_PROBE.width_mm / WIDTH)
    assert frame.picture.row_step_mm == pytest.approx(DEMO_PROBE.far_mm / HEIGHT)


def test_http(http: httpx.Client, expected: Any) -> None:
    body = {"pose": POSE_BODY, "probe": FAN_BODY, "display": BODY, "outputs": ["bmode", "coverage"], "dtype": "float32"}
    answer = http.post("/v1/scenes/demo/render", json=body)
    shape = [int(n) for n in answer.headers["X-Ultragray-Shape"].split(",")]
    assert shape == [2, 1, *expected.shape[1:]]
    np.testing.assert_allclose(np.frombuffer(answer.content, "<f4").reshape(expected.shape), expected, atol=1e-5)
    assert json.loads(answer.headers["X-Ultragray-Picture"])["step"] == [-0.9, 0.9]


def test_http_batches(http: httpx.Client, expected: Any) -> None:
    """Several parts of one request, and an archive packed of them."""
    body = {"poses": [POSE_BODY] * 9, "probe": FAN_BODY, "display": BODY, "outputs": ["bmode", "coverage"]}
    answer = http.post("/v1/scenes/demo/render", json=body, headers={"Accept": "application/octet-stream"})
    pixels = np.frombuffer(answer.content, "u1").reshape(2, 9, *expected.shape[1:])
    assert np.abs(pixels[:, 8] / 255.0 - expected).max() < 0.5001 / 255 + 1e-5


@pytest.mark.parametrize(
    ("display", "field", "reason"),
    [
        ({"gain_db": 1e6}, "display.gain_db", "INVALID_ARGUMENT"),
        ({"tgc_db": [0.0, 1e6]}, "display.tgc_db[1]", "INVALID_ARGUMENT"),
        ({"pixel_mm": 0.001}, "display.pixel_mm", "INVALID_IMAGE_SIZE"),
        ({"brightness": 1.0}, "display.brightness", "INVALID_ARGUMENT"),
    ],
)
def test_what_cannot_be_shown_is_refused(http: httpx.Client, display: Any, field: str, reason: str) -> None:
    answer = http.post("/v1/scenes/demo/render", json={"pose": POSE_BODY, "display": display})
    assert answer.status_code == 422
    assert (answer.json()["reason"], answer.json()["field"]) == (reason, field)


def test_websocket(service: RunningService, expected: Any) -> None:
    address = f"{service.http.replace('http', 'ws', 1)}/v1/scenes/demo/stream"
    with connect(address, compression=None) as connection:
        asked = {"probe": FAN_BODY, "display": BODY, "outputs": ["bmode", "coverage"], "encoding": "float32"}
        connection.send(json.dumps({"settings": asked, "pose": POSE_BODY}))
        message = connection.recv()
        connection.send(json.dumps({"settings": {"display": {"flip": 1}}}))
        refusal = json.loads(connection.recv())
    assert isinstance(message, bytes)
    length = int.from_bytes(message[:4], "little")
    about = json.loads(message[4 : 4 + length])
    assert about["display"] == to_dict(Display()) | BODY
    assert (about["rendered_height"], about["rendered_width"]) == (HEIGHT, WIDTH)
    assert about["picture"]["step"] == [-0.9, 0.9]
    pixels = np.frombuffer(message[4 + length :], "<f4").reshape(2, about["height"], about["width"])
    np.testing.assert_allclose(pixels, expected, atol=1e-5)
    assert refusal["error"]["field"] == "settings.display.flip"

"""The thickness of frames along elevation, through each front door: as trained, as asked for, and told for a replay."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import grpc
import httpx
import numpy as np
import pytest
from websockets.sync.client import connect

import ultragray_client
from ultragray import ElevationBeam, GaussianScene, render
from ultragray_client.contract import RenderSettings
from ultragray_proto.v1 import geometry_pb2, rendering_pb2, rendering_pb2_grpc
from ultragray_service.igtl.contents import unpack_image

from .conftest import HEIGHT, WIDTH, RunningService
from .igtl.conftest import Peer, address_of

BEAM = ElevationBeam(thickness_mm=3.0, focus_mm=15.0, depth_of_field_mm=20.0)
POSE = np.eye(4)
ASKED = [(None, BEAM), (0.0, ElevationBeam(0.0)), (6.0, BEAM.as_thick_as(6.0))]


@pytest.fixture(scope="module")
def thick(demo_scene: GaussianScene) -> GaussianScene:
    return replace(demo_scene, info=replace(demo_scene.info, beam=BEAM))


@pytest.fixture(scope="module")
def thick_service(
    start_service: Callable[..., RunningService], thick: GaussianScene, data_folder: Path, tmp_path_factory: Any
) -> RunningService:
    folder = tmp_path_factory.mktemp("thick")
    thick.save(folder / "thick.ugr")
    shutil.copy(data_folder / "demo.ugr", folder)
    return start_service(data_folder=folder, artifact_folder=tmp_path_factory.mktemp("artifacts"))


@pytest.fixture(scope="module")
def http(thick_service: RunningService) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=f"{thick_service.http}/v1/", timeout=60) as client:
        yield client


def frame_of(scene: GaussianScene, beam: ElevationBeam) -> np.ndarray:  # [H, W]
    bmode = render(scene, None, POSE, height=HEIGHT, width=WIDTH, outputs=("bmode",), beam=beam).bmode
    assert bmode is not None
    return bmode[0].numpy()


def body(thickness_mm: float | None, **fields: Any) -> dict[str, Any]:
    return {"pose": {"matrix": POSE.tolist()}, "dtype": "float32", "slice_thickness_mm": thickness_mm, **fields}


@pytest.mark.parametrize(("thickness_mm", "beam"), ASKED)
def test_http(http: httpx.Client, thick: GaussianScene, thickness_mm: float | None, beam: ElevationBeam) -> None:
    answer = http.post("scenes/thick/render", json=body(thickness_mm), headers={"Accept": "application/octet-stream"})
    pixels = np.frombuffer(answer.content, "<f4").reshape(HEIGHT, WIDTH)
    np.testing.assert_allclose(pixels, frame_of(thick, beam), atol=1e-6)
    assert float(answer.headers["X-Ultragray-Slice-Thickness-Mm"]) == beam.thickness_mm


def test_frames_of_each_thickness_differ(thick: GaussianScene) -> None:
    frames = [frame_of(thick, beam) for _, beam in ASKED]
    assert np.abs(frames[0] - frames[1]).max() > 0.05
    assert np.abs(frames[0] - frames[2]).max() > 0.05


def test_a_scene_without_a_beam_takes_the_thickness_at_every_depth(
    http: httpx.Client, demo_scene: GaussianScene
) -> None:
    answer = http.post("scenes/demo/render", json=body(4.0), headers={"Accept": "application/octet-stream"})
    pixels = np.frombuffer(answer.content, "<f4").reshape(HEIGHT, WIDTH)
    np.testing.assert_allclose(pixels, frame_of(demo_scene, ElevationBeam(4.0)), atol=1e-6)


@pytest.mark.parametrize("thickness_mm", [-1.0, 101.0])
def test_beyond_its_limits_it_is_refused(http: httpx.Client, thickness_mm: float) -> None:
    answer = http.post("scenes/thick/render", json=body(thickness_mm))
    assert (answer.status_code, answer.json()["field"]) == (422, "slice_thickness_mm")


def test_a_scene_tells_its_beam(http: httpx.Client, thick_service: RunningService) -> None:
    told = {"thickness_mm": 3.0, "focus_mm": 15.0, "depth_of_field_mm": 20.0}
    assert http.get("scenes/thick").json()["beam"] == told
    assert http.get("scenes/demo").json()["beam"] is None
    with ultragray_client.Client(thick_service.grpc) as client:
        assert client.scenes.get("thick").beam == ultragray_client.ElevationBeam(**told)
        assert client.scenes.get("demo").beam is None


def test_grpc_and_its_client(thick_service: RunningService, thick: GaussianScene) -> None:
    with ultragray_client.Client(thick_service.grpc) as client:
        for thickness_mm, beam in ASKED:
            settings = RenderSettings(slice_thickness_mm=thickness_mm, encoding=ultragray_client.Encoding.FLOAT32)
            frame = client.render("thick", POSE, settings)
            assert frame.slice_thickness_mm == beam.thickness_mm
            np.testing.assert_allclose(frame["bmode"], frame_of(thick, beam), atol=1e-6)
            again = client.render("thick", frame.pose, replace(settings, slice_thickness_mm=frame.slice_thickness_mm))
            assert np.array_equal(again["bmode"], frame["bmode"])
    with thick_service.channel() as channel:
        stub = rendering_pb2_grpc.RenderServiceStub(channel)
        pose = geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=POSE.ravel().tolist()))
        settings = rendering_pb2.RenderSettings(scene="thick", slice_thickness_mm=-2.0)
        with pytest.raises(grpc.RpcError, match="slice_thickness_mm must be a finite number from 0"):
            stub.Render(rendering_pb2.RenderRequest(settings=settings, pose=pose))


def test_websocket(thick_service: RunningService, thick: GaussianScene) -> None:
    address = f"{thick_service.http.replace('http', 'ws', 1)}/v1/scenes/thick/stream"
    with connect(address, compression=None) as connection:
        for thickness_mm, beam in ASKED:
            settings = {"slice_thickness_mm": thickness_mm, "encoding": "float32"}
            connection.send(json.dumps({"settings": settings, "pose": {"matrix": POSE.tolist()}}))
            message = connection.recv()
            assert isinstance(message, bytes)
            length = 4 + int.from_bytes(message[:4], "little")
            assert json.loads(message[4:length])["slice_thickness_mm"] == beam.thickness_mm
            pixels = np.frombuffer(message[length:], "<f4").reshape(HEIGHT, WIDTH)
            np.testing.assert_allclose(pixels, frame_of(thick, beam), atol=1e-6)


@pytest.mark.parametrize(("settings", "beam"), [({}, BEAM), ({"igtl_slice_thickness_mm": 0.0}, ElevationBeam(0.0))])
def test_openigtlink(
    start_service: Callable[..., RunningService],
    thick: GaussianScene,
    tmp_path: Path,
    settings: dict[str, float],
    beam: ElevationBeam,
) -> None:
    thick.save(tmp_path / "thick.ugr")
    service = start_service(data_folder=tmp_path, igtl_port=0, **settings)
    peer = Peer(address_of(service))
    peer.send_pose(POSE, "thick", version=2)
    message = peer.receive()
    peer.socket.close()
    assert message.metadata["slice_thickness_mm"] == repr(beam.thickness_mm)
    pixels = unpack_image(message.content).pixels / 255.0
    np.testing.assert_allclose(pixels, frame_of(thick, beam), atol=0.501 / 255.0)


def test_render_jobs_take_it(http: httpx.Client) -> None:
    specification = {"scene": "thick", "poses": [POSE.tolist()], "slice_thickness_mm": 6.0}
    taken = http.post("jobs", json={"kind": "render", "specification": specification}).json()
    assert taken["specification"]["slice_thickness_mm"] == 6.0
    specification["slice_thickness_mm"] = -1.0
    refused = http.post("jobs", json={"kind": "render", "specification": specification}).json()
    assert refused["field"] == "specification.slice_thickness_mm"

"""More asked for than can be rendered, and scenes that would take for ever: answers of a real service."""

import contextlib
import threading

import grpc
import httpx
import pytest

from ultragray_proto.v1 import rendering_pb2, rendering_pb2_grpc

from ..waiting import wait_until
from ..workers.pool.test_costly_scenes import save_wide
from .conftest import DEMO_PROBE, make_scene
from .rpc.test_grpc_render import error_info, moved

IDENTITY = {"position_mm": {"x": 0, "y": 0, "z": 0}, "quaternion": {"w": 1, "x": 0, "y": 0, "z": 0}}
LARGE = {"height": 512, "width": 512}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """`demo`, and scenes of 20,000 Gaussians of 148 cm and of e^20 cm before the probe."""
    folder = tmp_path_factory.mktemp("scenes")
    make_scene(probe=DEMO_PROBE).save(folder / "demo.ugr")
    for name, log_scale in (("wide", 5.0), ("endless", 20.0)):
        save_wide(folder, name, count=20_000, log_scale=log_scale)
    return folder


def render(client, scene, **body):
    return client.post(f"/v1/scenes/{scene}/render", json={"pose": IDENTITY, **body}, timeout=300)


@pytest.fixture(scope="module")
def strict(start_service, scenes):
    return start_service(data_folder=scenes)


@pytest.mark.parametrize("scene", ["wide", "endless"])
def test_a_scene_that_would_take_minutes_is_refused_by_both_doors(strict, scene):
    with httpx.Client(base_url=strict.http, timeout=300) as client, strict.channel() as channel:
        refused = render(client, scene, **LARGE)
        assert (refused.status_code, refused.json()["reason"], refused.json()["field"]) == (
            422,
            "FRAME_TOO_COSTLY",
            "pose",
        )
        assert "may cost 2,147 million footprint pixels" in refused.json()["detail"]
        stub = rendering_pb2_grpc.RenderServiceStub(channel)
        settings = rendering_pb2.RenderSettings(scene=scene, **LARGE)
        with pytest.raises(grpc.RpcError) as caught:
            stub.Render(rendering_pb2.RenderRequest(settings=settings, pose=moved(0)), timeout=300)
        assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT
        assert error_info(caught.value)[0].reason == "FRAME_TOO_COSTLY"
        with pytest.raises(grpc.RpcError) as caught:
            list(stub.RenderBatch(rendering_pb2.RenderBatchRequest(settings=settings, poses=[moved(0)]), timeout=300))
        assert error_info(caught.value)[0].metadata["field"] == "poses[0]"
        plane = {"origin_mm": [-20, 0, 0], "size_mm": [40.96, 40.96], "spacing_mm": 0.02}
        refused = client.post(f"/v1/scenes/{scene}:slice", json=plane)
        assert (refused.json()["reason"], refused.json()["field"]) == ("FRAME_TOO_COSTLY", "spacing_mm")
        assert render(client, "demo").status_code == 200
    assert strict.metric("ultragray_process_restarts_total") == strict.metric("ultragray_watchdog_kills_total") == 0


@pytest.mark.long
def test_a_request_names_how_long_it_waits_to_begin(start_service, scenes):
    service = start_service(data_folder=scenes, backend="reference", max_batch_poses=1, max_queue_ms=600_000)
    poses, size = [IDENTITY] * 256, {"height": 64, "width": 64}

    def fill():
        with contextlib.suppress(httpx.HTTPError):  # the service stops before it is done
            httpx.post(f"{service.http}/v1/scenes/demo/render", json={"poses": poses, **size}, timeout=600)

    with httpx.Client(base_url=service.http, timeout=300) as client, service.channel() as channel:
        assert render(client, "demo", max_queue_ms=60_000, **size).status_code == 200
        threading.Thread(target=fill, daemon=True).start()
        wait_until(lambda: service.metric("ultragray_waiting_frames") > 0)
        refused = render(client, "demo", poses=poses[:2], pose=None, max_queue_ms=20, **size)
        assert (refused.status_code, refused.json()["reason"]) == (429, "QUEUE_FULL")
        assert int(refused.headers["Retry-After"]) >= 1
        request = rendering_pb2.RenderRequest(
            settings=rendering_pb2.RenderSettings(scene="demo"), pose=moved(0), max_queue_ms=0.0
        )
        with pytest.raises(grpc.RpcError) as caught:
            rendering_pb2_grpc.RenderServiceStub(channel).Render(request, timeout=300)
        assert error_info(caught.value)[0].metadata["field"] == "max_queue_ms"
        request.max_queue_ms = 60_000
        assert rendering_pb2_grpc.RenderServiceStub(channel).Render(request, timeout=300).data

"""Whatever is sent, no answer tells a folder of the server or shows a value as Python writes it."""

import json
import re
import tempfile
from pathlib import Path

import grpc
import numpy as np
import pytest
from websockets.sync.client import connect

from ultragray_proto.v1 import geometry_pb2, jobs_pb2, jobs_pb2_grpc, rendering_pb2, scenes_pb2, scenes_pb2_grpc

from .conftest import ROOT

PYTHON = re.compile(
    r"<class|<built-in|object at 0x|PosixPath|NoneType|\bNone\b|\bTrue\b|\bFalse\b|Traceback|\.py\b|Errno"
)
GOOD_POSE = {"matrix": np.eye(4).tolist()}
HOSTILE = [None, True, False, "", "\0", "a\nb", -1, 1e308, 10**400, [], [None], {}, {"a": None}, ["x"] * 200]
ENCODED = ("%00", "..%2f..%2fetc%2fpasswd", "%2Fetc%2Fpasswd", "a%0Ab", "%ff", "None", "x" * 300, "demo:", "*", "%20")
PATHS = (
    "/v1/scenes/{}", "/v1/scenes/{}/file", "/v1/scenes/{}/gaussians", "/v1/scenes/{}/comparison",
    "/v1/scenes?page_size={}", "/v1/scenes?page_token={}", "/v1/datasets/{}", "/v1/datasets/{}/poses",
    "/v1/datasets/{}/contact-sheet", "/v1/datasets?page_token={}", "/v1/jobs/{}", "/v1/jobs/{}/log",
    "/v1/jobs/{}/artifacts/{}", "/v1/jobs/{}/events", "/v1/jobs?state={}", "/v1/jobs?page_token={}", "/v1/{}",
    "/assets/{}", "/package/{}",
)  # fmt: skip


def check(service, text):
    folders = (str(service.data_folder), str(ROOT), tempfile.gettempdir(), str(Path.home()))
    assert not [folder for folder in folders if folder in text], text
    assert not PYTHON.search(text), text


RENDER, JOB = (
    {"pose": GOOD_POSE},
    {"kind": "render", "specification": {"scene": "nowhere", "poses": [GOOD_POSE["matrix"]]}},
)
BODIES = {
    **dict.fromkeys(
        ("pose", "poses", "outputs", "height", "probe", "display", "dtype"), ("scenes/demo/render", RENDER)
    ),
    **dict.fromkeys(("kind", "specification", "request_id", "priority"), ("jobs", JOB)),
}


@pytest.mark.parametrize(
    "key", [*BODIES, *(f"specification {key}" for key in ("scene", "poses", "sampler", "outputs"))]
)
def test_bodies(service, http, key):
    path, body = BODIES[key.partition(" ")[0]]
    for value in HOSTILE:
        asked = {**body, key: value}
        if inner := key.partition(" ")[2]:
            asked = {**JOB, "specification": {**JOB["specification"], inner: value}}
        answer = http.post(f"/v1/{path}", content=json.dumps(asked), headers={"Accept": "image/png"})
        assert answer.status_code < 500, answer.text
        if answer.status_code >= 400:
            check(service, answer.text)


@pytest.mark.parametrize("path", PATHS)
def test_paths_and_queries(service, http, path):
    for value in ENCODED:
        answer = http.get(path.replace("{}", value))
        assert answer.status_code < 500, answer.text
        if answer.status_code >= 400:
            check(service, answer.text.replace("None", "") if value == "None" else answer.text)


@pytest.mark.parametrize("scene", ["truncated", "foreign", "empty", "probeless", "nowhere"])
def test_scenes_that_cannot_be_used(service, http, scene):
    for answer in (
        http.get(f"/v1/scenes/{scene}"),
        http.post(f"/v1/scenes/{scene}:load"),
        http.post(f"/v1/scenes/{scene}/render", json={"pose": GOOD_POSE}),
        http.get(f"/v1/scenes/{scene}/file") if scene != "probeless" else http.get("/v1/scenes"),
    ):
        check(service, answer.text)


@pytest.mark.parametrize("text", ["{}", "[null]", '{"pose": null, "settings": {"height": null}}', '{"settings": 1}'])
def test_messages_of_streams(service, text):
    for scene in ("demo", "truncated"):
        address = f"{service.http.replace('http', 'ws', 1)}/v1/scenes/{scene}/stream"
        try:
            with connect(address) as stream:
                stream.send(text)
                stream.send('{"pose": {"matrix": null}}')
                check(service, str(stream.recv(timeout=300)))
        except Exception as error:
            check(service, str(error))


def test_calls(service, channel, renders):
    pose = geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=np.eye(4).ravel()))
    scenes, jobs = scenes_pb2_grpc.SceneServiceStub(channel), jobs_pb2_grpc.JobServiceStub(channel)
    for scene in ("", "truncated", "foreign", "../demo", "\0", "nowhere"):
        settings = rendering_pb2.RenderSettings(scene=scene)
        for call in (
            lambda settings=settings: renders.Render(rendering_pb2.RenderRequest(settings=settings, pose=pose)),
            lambda settings=settings: renders.Render(rendering_pb2.RenderRequest(settings=settings)),
            lambda scene=scene: scenes.GetScene(scenes_pb2.GetSceneRequest(scene=scene)),
            lambda scene=scene: jobs.GetJob(jobs_pb2.GetJobRequest(job=scene)),
            lambda scene=scene: jobs.ListJobs(jobs_pb2.ListJobsRequest(page_token=scene or "*")),
        ):
            with pytest.raises(grpc.RpcError) as caught:
                call()
            assert caught.value.code() not in (grpc.StatusCode.UNKNOWN, grpc.StatusCode.INTERNAL)
            check(service, str(caught.value.details()))

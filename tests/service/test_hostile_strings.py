"""Strings that PostgreSQL, UTF-8 or a file system cannot hold, in every field of text: refused, never a fault."""

import json
from urllib.parse import quote

import grpc
import httpx
import numpy as np
import pytest

from ultragray_proto.v1 import datasets_pb2, datasets_pb2_grpc, jobs_pb2, jobs_pb2_grpc, scenes_pb2, scenes_pb2_grpc

from ..workers.jobs.conftest import store_dataset

UNSTORABLE = {"nul": "a\0b", "surrogate": "a\ud800b", "long": "x" * 10_000}
POSES = [np.eye(4).tolist()]


@pytest.fixture(scope="module")
def stored(start_service, postgres, tmp_path_factory):
    folder = tmp_path_factory.mktemp("artifacts")
    store_dataset(folder, "tiny")
    return start_service(artifact_folder=folder, database_url=postgres.create_database())


def bodies(text):
    render = {"scene": "demo", "poses": POSES, "height": 8, "width": 8}
    train = {"dataset": "tiny", "scene": "new", "settings": {"steps": 1}}
    evaluate = {"dataset": "tiny", "scene": "demo"}
    asked = [{"kind": "render", "specification": render, "request_id": text}, {"kind": text, "specification": render}]
    for kind, whole in (("render", render), ("train", train), ("evaluate", evaluate), ("compare", {"dataset": "tiny"})):
        for name in {*whole, "scene", "dataset", "format", "dtype", "device", "preset", "budget"} - {"poses"}:
            asked.append({"kind": kind, "specification": {**whole, name: text}})
    asked.append({"kind": "render", "specification": render, "priority": text})
    asked.append({"kind": "train", "specification": {**train, "settings": {text: 1}}})
    return asked


@pytest.mark.parametrize("text", UNSTORABLE.values(), ids=UNSTORABLE)
def test_http(stored, text):
    with httpx.Client(base_url=stored.http, timeout=60) as http:
        for body in bodies(text):
            answer = http.post("/v1/jobs", content=json.dumps(body))
            assert answer.status_code in (400, 404, 413, 422), (body, answer.text)
            assert answer.json()["reason"]
        name = quote(text.encode("utf-8", "surrogatepass"), safe="")
        for path in ("jobs", "scenes", "datasets"):
            answer = http.get(f"/v1/{path}/{name}")
            assert 400 <= answer.status_code < 500, answer.text
            answer = http.get(f"/v1/{path}?page_token={name}")
            assert 400 <= answer.status_code < 500, answer.text
        for path in (f"/v1/jobs?state={name}", f"/v1/jobs/{name}/artifacts/{name}", f"/v1/jobs/{name}/log"):
            assert 400 <= http.get(path).status_code < 500
        for path in (f"/v1/datasets/{name}", f"/v1/scenes/{name}"):
            assert 400 <= http.put(path, content=b"x").status_code < 500
            assert 400 <= http.delete(path).status_code < 500


@pytest.mark.parametrize("text", [UNSTORABLE["nul"], UNSTORABLE["long"]], ids=["nul", "long"])  # protobuf has no others
def test_grpc(stored, text):
    render = {"scene": "demo", "height": 8, "width": 8}
    with stored.channel() as channel:
        jobs, scenes = jobs_pb2_grpc.JobServiceStub(channel), scenes_pb2_grpc.SceneServiceStub(channel)
        datasets = datasets_pb2_grpc.DatasetServiceStub(channel)
        calls = [
            (jobs.SubmitJob, jobs_pb2.SubmitJobRequest(render=jobs_pb2.RenderJob(**{**render, name: text})))
            for name in ("scene", "format", "dtype", "device")
            if name in jobs_pb2.RenderJob.DESCRIPTOR.fields_by_name
        ]
        train = {"dataset": "tiny", "scene": "new"}
        calls += [
            (jobs.SubmitJob, jobs_pb2.SubmitJobRequest(train=jobs_pb2.TrainJob(**{**train, name: text})))
            for name in ("dataset", "scene", "preset", "device")
        ]
        whole = jobs_pb2.TrainJob(dataset="tiny", scene="new")
        calls += [
            (jobs.SubmitJob, jobs_pb2.SubmitJobRequest(train=whole, request_id=text)),
            (jobs.GetJob, jobs_pb2.GetJobRequest(job=text)),
            (jobs.CancelJob, jobs_pb2.CancelJobRequest(job=text)),
            (jobs.ListJobs, jobs_pb2.ListJobsRequest(page_token=text)),
            (scenes.GetScene, scenes_pb2.GetSceneRequest(scene=text)),
            (scenes.ListScenes, scenes_pb2.ListScenesRequest(page_token=text)),
            (datasets.GetDataset, datasets_pb2.GetDatasetRequest(dataset=text)),
            (datasets.DeleteDataset, datasets_pb2.DeleteDatasetRequest(dataset=text)),
        ]
        for call, request in calls:
            with pytest.raises(grpc.RpcError) as refused:
                call(request, timeout=60)
            codes = (grpc.StatusCode.INVALID_ARGUMENT, grpc.StatusCode.NOT_FOUND)
            assert refused.value.code() in codes, (request, refused.value.details())


def test_the_log_has_no_fault(stored):
    assert not [record for record in stored.log() if record["level"] == "error"]

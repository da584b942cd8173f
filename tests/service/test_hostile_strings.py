"""Strings that PostgreSQL, UTF-8 or a file system cannot hold, in every field of text: refused, never a fault."""

import json
from urllib.parse import quote

import httpx
import numpy as np
import pytest

from ..workers.jobs.conftest import store_dataset

UNSTORABLE = {"nul": "a\0b", "surrogate": "a\ud800b", "long": "x" * 10_000}
POSES = [np.eye(4).tolist()]


@pytest.fixture(scope="module")
def stored(start_service, postgres, artifacts):
    folder = artifacts
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


def test_the_log_has_no_fault(stored):
    assert not [record for record in stored.log() if record["level"] == "error"]

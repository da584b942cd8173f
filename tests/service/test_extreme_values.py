"""Strings that no database or file system holds, and numbers at the edge of what a float or an integer can be."""

import json
import sys
from dataclasses import MISSING
from typing import get_args, get_origin
from urllib.parse import quote

import httpx
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from ultragray.contract import Contract, Family, annotated_fields, optional_of
from ultragray.rendering.settings import RenderSettings

from ..workers.jobs.conftest import store_dataset

UNSTORABLE = {"nul": "a\0b", "surrogate": "a\ud800b", "long": "x" * 10_000}


@pytest.fixture(scope="module")
def stored(start_service, postgres, artifacts):
    store_dataset(artifacts, "tiny")
    return start_service(artifact_folder=artifacts, database_url=postgres.create_database())


def bodies(text):
    render = {"scene": "demo", "poses": [POSE["matrix"]], "height": 8, "width": 8}
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
def test_strings(stored, text):
    with httpx.Client(base_url=stored.http, timeout=300) as http:
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


TIMEOUT_S = 300.0
MANY = settings(deadline=None, max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
EDGES = (0.0, 5e-324, 2.2e-308, 1e-300, 1e-45, 1e-38, 1e-30, 1e-9, 1.0, 1e9, 3.4e38, 1e39, 1e300, sys.float_info.max)
HUGE = (2**31 - 1, 2**31, 2**53 + 1, 2**63, 2**64, 10**400)
POSE = {"matrix": np.eye(4).tolist()}


def numbers(item):
    """What a field takes, from one limit to the other; the limits and their neighbours; and what no field takes."""
    limits = [item.metadata[name] for name in ("low", "high", "above") if name in item.metadata]
    near = [float(np.nextafter(limit, toward)) for limit in limits for toward in (-np.inf, np.inf)]
    low, high = min(limits, default=None), max(limits, default=None)
    within = st.floats(low, high if high != low else None, allow_nan=False, allow_infinity=False)
    return within | st.sampled_from([*limits, *near, *EDGES, *(-edge for edge in EDGES)])


def values(annotation, item):
    kind, optional = optional_of(annotation)
    if kind is float:
        found = numbers(item)
    elif kind is int:
        found = st.sampled_from([0, 1, 2, 33, 512, 600, 601]) | st.sampled_from([*HUGE, *(-one for one in HUGE)])
    elif kind is bool:
        found = st.booleans()
    elif get_origin(kind) is tuple and get_args(kind)[0] is float:
        found = st.lists(numbers(item), max_size=4)
    elif isinstance(kind, type) and issubclass(kind, Family) and Family in kind.__bases__:
        found = st.one_of([documents(member) for member in kind.members.values()])
    elif isinstance(kind, type) and issubclass(kind, Contract):
        found = documents(kind)
    else:
        return st.nothing()
    return st.none() | found if optional else found


def documents(cls):
    """JSON of a class of the contract: fields without a default always, each of the others now and then."""
    fields = {item.name: (item, values(annotation, item)) for item, annotation in annotated_fields(cls)}
    given = {name: found for name, (_, found) in fields.items() if not found.is_empty}
    required = {name for name, (item, _) in fields.items() if name in given and not _has_default(item)}
    if "kind" in fields:
        given["kind"] = st.just(cls.kind)
        required.add("kind")
    return st.fixed_dictionaries(
        {name: found for name, found in given.items() if name in required},
        optional={name: found for name, found in given.items() if name not in required},
    )


def _has_default(item):
    return item.default is not MISSING or item.default_factory is not MISSING


POSES = st.one_of(
    st.fixed_dictionaries(
        {
            "position_mm": st.fixed_dictionaries({axis: st.sampled_from(EDGES) for axis in "xyz"}),
            "quaternion": st.fixed_dictionaries({axis: st.sampled_from(EDGES) for axis in "wxyz"}),
        }
    ),
    st.fixed_dictionaries(
        {"matrix": st.lists(st.lists(st.sampled_from(EDGES), min_size=4, max_size=4), min_size=4, max_size=4)}
    ),
    st.just(POSE),
)
DEEP = {"height": 512, "display": {"depth_mm": 1e308}}
EXTREME = given(asked=documents(RenderSettings), pose=st.just(POSE) | POSES)


@EXTREME
@example(asked=DEEP, pose=POSE)
@MANY
def test_numbers(http, asked, pose):
    answer = http.post("/v1/scenes/demo/render", content=json.dumps({**asked, "pose": pose}), timeout=TIMEOUT_S)
    assert answer.status_code in (200, 422), answer.text
    assert answer.status_code == 200 or answer.json()["field"], answer.text

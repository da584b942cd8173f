"""Numbers at the edge of what a float or an integer can be, in every field of the contract, through every door."""

import json
import sys
from dataclasses import MISSING
from typing import get_args, get_origin

import numpy as np
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from ultragray.contract import Contract, Family, annotated_fields, optional_of
from ultragray.rendering.settings import RenderSettings

TIMEOUT_S = 60.0
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
def test_http(http, asked, pose):
    answer = http.post("/v1/scenes/demo/render", content=json.dumps({**asked, "pose": pose}), timeout=TIMEOUT_S)
    assert answer.status_code in (200, 422), answer.text
    assert answer.status_code == 200 or answer.json()["field"], answer.text

"""What the service tells of probes that are shown to it."""

from __future__ import annotations

import math
from typing import Any

import httpx
import numpy as np
import pytest

LINEAR = {"kind": "linear", "width_mm": 40.0, "near_mm": 5.0, "far_mm": 50.0}
CONVEX = {"kind": "convex", "opening_angle_deg": 60.0, "near_mm": 40.0, "far_mm": 90.0}


def plane(http: httpx.Client, probe: dict[str, Any]) -> tuple[float, np.ndarray]:  # [W, 2, 2]: line, end, (x, z)
    answer = http.post("/v1/probes:plane", json=probe)
    assert answer.status_code == 200, answer.text
    document = answer.json()
    return document["face_depth_mm"], np.array(document["lines_mm"]).reshape(-1, 2, 2)


def test_lines_run_from_the_left_edge_of_the_image_to_its_right_one(http: httpx.Client) -> None:
    face_depth_mm, lines = plane(http, LINEAR)
    assert face_depth_mm == 0.0
    np.testing.assert_allclose(lines[:, :, 0], np.linspace(-20.0, 20.0, len(lines))[:, None] * np.ones(2), atol=1e-6)
    np.testing.assert_allclose(lines[:, :, 1], np.tile([5.0, 50.0], (len(lines), 1)))


def test_lines_of_a_fan_begin_at_its_face(http: httpx.Client) -> None:
    face_depth_mm, lines = plane(http, CONVEX)
    assert face_depth_mm == 40.0
    np.testing.assert_allclose(np.linalg.norm(lines, axis=2), np.tile([40.0, 90.0], (len(lines), 1)), atol=1e-5)
    angles_deg = np.degrees(np.arctan2(lines[:, 1, 0], lines[:, 1, 1]))
    np.testing.assert_allclose(angles_deg, np.linspace(-30.0, 30.0, len(lines)), atol=1e-4)


def test_each_kind_has_an_example_that_can_be(http: httpx.Client) -> None:
    schemas = http.get("/openapi.json").json()["components"]["schemas"]
    mapping = schemas["RenderSettings"]["properties"]["probe"]["anyOf"][0]["discriminator"]["mapping"]
    assert {"linear", "convex", "phased"} <= mapping.keys()
    for kind, reference in mapping.items():
        (example,) = schemas[reference.rpartition("/")[2]]["examples"]
        assert example["kind"] == kind
        face_depth_mm, lines = plane(http, example)
        assert math.isfinite(face_depth_mm)
        assert np.isfinite(lines).all()


@pytest.mark.parametrize(
    ("probe", "field"),
    [
        ({**LINEAR, "far_mm": 5.0}, "far_mm"),
        ({**LINEAR, "width_mm": "wide"}, "width_mm"),
        ({"kind": "curved"}, "kind"),
    ],
)
def test_a_probe_that_cannot_be_is_refused(http: httpx.Client, probe: dict[str, Any], field: str) -> None:
    answer = http.post("/v1/probes:plane", json=probe)
    assert answer.status_code == 422
    assert field in answer.json()["field"] + answer.json()["detail"]

"""Rendered frames as DICOM: what a viewer reads out of them is what was rendered."""

from __future__ import annotations

import io
import json
from typing import Any

import httpx
import numpy as np
import pydicom
import pytest

from ..conftest import HEIGHT, WIDTH

DICOM = {"Accept": "application/dicom"}


def stored(http: httpx.Client, body: dict[str, Any]) -> tuple[httpx.Response, pydicom.FileDataset]:
    answer = http.post("/v1/scenes/demo/render", json=body, headers=DICOM)
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/dicom"
    return answer, pydicom.dcmread(io.BytesIO(answer.content))


def test_one_frame_holds_the_pixels_and_their_spacing(http: httpx.Client, pose_body: Any) -> None:
    answer, image = stored(http, {"pose": pose_body, "display": {"gain_db": 6.0}})
    raw = http.post(
        "/v1/scenes/demo/render",
        json={"pose": pose_body, "display": {"gain_db": 6.0}},
        headers={"Accept": "application/octet-stream"},
    )
    assert image.pixel_array.tobytes() == raw.content
    picture = json.loads(answer.headers["x-ultragray-picture"])
    region = image.SequenceOfUltrasoundRegions[0]
    assert (region.PhysicalDeltaX, region.PhysicalDeltaY) == pytest.approx([step / 10 for step in picture["step"]])
    assert (image.NumberOfFrames, image.Rows, image.Columns) == (1, HEIGHT, WIDTH)


def test_a_loop_of_a_sector_is_scan_converted(http: httpx.Client, pose_body: Any) -> None:
    probe = {"kind": "convex", "opening_angle_deg": 60.0, "near_mm": 40.0, "far_mm": 90.0}
    _, image = stored(http, {"poses": [pose_body] * 3, "probe": probe})
    region = image.SequenceOfUltrasoundRegions[0]
    assert image.NumberOfFrames == 3
    assert region.PhysicalDeltaX == pytest.approx(region.PhysicalDeltaY)
    assert region.PhysicalDeltaY * 10 * image.Rows == pytest.approx(55.4, abs=1.5)  # 90 mm - 40 mm · cos 30°
    frames = image.pixel_array
    assert np.array_equal(frames[0], frames[2])


def test_other_outputs_and_float_pixels_are_refused(http: httpx.Client, pose_body: Any) -> None:
    for extra, field in [({"outputs": ["echo"]}, "outputs"), ({"dtype": "float32"}, "dtype")]:
        answer = http.post("/v1/scenes/demo/render", json={"pose": pose_body, **extra}, headers=DICOM)
        assert (answer.status_code, answer.json()["field"]) == (422, field)

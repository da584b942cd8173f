from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from ultragray import ConvexProbe, LinearProbe
from ultragray.geometry.probe import Probe
from ultragray.geometry.scan_conversion import scan_convert
from ultragray.rendering.display import true_to_scale
from ultragray.rendering.frames import show
from ultragray.rendering.settings import Resolved
from ultragray.scene.confidence import Extrapolation
from ultragray_service.igtl.frames import image_of
from ultragray_workers.pool.messages import RenderResult

from .conftest import FAN, random_pose


def result_of(frame: Any, probe: Probe, pose: Any, max_side: int = 2048) -> RenderResult:
    """As the pool answers it."""
    display = true_to_scale(probe, frame.shape[0], max_side)
    shown = show({"bmode": torch.from_numpy(frame[None])}, probe, display)["bmode"][0].numpy()
    return RenderResult(
        scene="demo",
        scene_sha256="",
        renderer="",
        poses=pose[None],
        settings=Resolved(probe, *frame.shape, display=display),
        data=shown.tobytes(),
        queue_ms=0,
        render_ms=0,
        encode_ms=0,
        extrapolations=(Extrapolation(None, None, None, None),),
        batch_size=1,
    )


def spot(shape: tuple[int, int], row: int, column: int) -> Any:
    frame = np.zeros(shape, np.uint8)
    frame[row - 1 : row + 2, column - 1 : column + 2] = 100
    frame[row, column] = 255
    return frame


def place_of_brightest(image: Any) -> Any:
    j, i = np.unravel_index(int(np.argmax(image.pixels)), image.pixels.shape)
    return (image.matrix @ (i, j, 0, 1))[:3]


@pytest.mark.parametrize("probe", [LinearProbe(38.0, 5.0, 50.0), FAN])
@pytest.mark.parametrize(("row", "column"), [(20, 10), (50, 90), (90, 50)])
def test_a_spot_is_where_the_probe_says(probe: Probe, row: int, column: int) -> None:
    pose = random_pose(3)
    image = image_of(result_of(spot((100, 100), row, column), probe, pose))
    origins, directions = probe.scan_lines(100)
    along = probe.depths_mm(100)[row]
    expected = (pose @ np.append(origins[column] + along * directions[column], 1.0))[:3]
    assert np.linalg.norm(place_of_brightest(image) - expected) < 0.4  # a pixel's diagonal


def test_a_linear_frame_is_sent_as_it_is() -> None:
    frame = np.random.default_rng(0).integers(0, 256, (30, 20), np.uint8)
    image = image_of(result_of(frame, LinearProbe(40.0, 0.0, 60.0), np.eye(4)))
    assert np.array_equal(image.pixels, frame)
    expected = [[2, 0, 0, -19], [0, 0, -1, 0], [0, 2, 0, 1], [0, 0, 0, 1]]
    assert np.array_equal(image.matrix, expected)
    assert np.linalg.det(image.matrix[:3, :3]) > 0


def test_a_fan_is_scan_converted() -> None:
    frame = np.random.default_rng(0).integers(0, 256, (80, 60), np.uint8)
    image = image_of(result_of(frame, FAN, np.eye(4)))
    expected = scan_convert(frame, FAN, 0.5)  # 40 mm in 80 samples
    assert image.pixels.shape == expected.shape
    assert np.abs(image.pixels - expected).max() <= 0.51
    assert (image.pixels[expected == 0] == 0).all()
    assert image.matrix[:3, :2] == pytest.approx(np.array([[0.5, 0], [0, 0], [0, 0.5]]))
    top_mm = FAN.near_mm * math.cos(math.radians(30))
    assert image.matrix[2, 3] == pytest.approx(top_mm + 0.25)


def test_a_fan_that_would_be_too_large_gets_larger_pixels() -> None:
    probe = ConvexProbe(opening_angle_deg=170.0, near_mm=9990.0, far_mm=10_000.0)
    image = image_of(result_of(np.full((64, 64), 200, np.uint8), probe, np.eye(4), 300))
    assert max(image.pixels.shape) in (299, 300)
    assert image.pixels.max() == 200

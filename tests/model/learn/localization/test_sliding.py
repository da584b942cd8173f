"""Frames slide with motions of the probe within its image plane."""

import pytest
import torch

from ultragray import ConvexProbe, LinearProbe
from ultragray.learn.localization.search import Motions, places_after, slid
from ultragray.learn.sweep import pixel_positions_mm

ROWS, COLUMNS = 41, 21
LINEAR = LinearProbe(40.0, 0.0, 80.0)
CONVEX = ConvexProbe(60.0, 20.0, 100.0)  # as deep as the linear one
POSITIONS = pixel_positions_mm(LINEAR, ROWS, COLUMNS).reshape(ROWS, COLUMNS, 3)
ACROSS_MM, DOWN_MM = float(POSITIONS[0, 1, 0] - POSITIONS[0, 0, 0]), float(POSITIONS[1, 0, 2] - POSITIONS[0, 0, 2])


def frames(count=2):
    return torch.rand(count, ROWS, COLUMNS, generator=torch.Generator().manual_seed(0))


def after(probe, *steps):  # [6] mm each -> [K, S, ROWS, COLUMNS]
    motions = Motions.of(probe).of_steps(torch.tensor(steps, dtype=torch.float64))
    return slid(frames(), places_after(probe, motions, ROWS, COLUMNS))


@pytest.mark.parametrize("probe", [LINEAR, CONVEX], ids=["linear", "convex"])
def test_without_a_motion_they_stay(probe):
    torch.testing.assert_close(after(probe, (0.0,) * 6)[:, 0], frames(), atol=1e-4, rtol=0.0)


def test_a_probe_that_moves_by_a_pixel_sees_what_was_beside_it():
    aside, deeper = after(LINEAR, (ACROSS_MM, 0, 0, 0, 0, 0), (0, 0, DOWN_MM, 0, 0, 0)).unbind(dim=1)
    torch.testing.assert_close(aside[..., :-1], frames()[..., 1:], atol=1e-4, rtol=0.0)
    torch.testing.assert_close(deeper[:, :-1], frames()[:, 1:], atol=1e-4, rtol=0.0)


def test_on_a_fan_only_the_middle_line_moves_along_itself():
    deeper = after(CONVEX, (0, 0, DOWN_MM, 0, 0, 0))[:, 0]
    middle = COLUMNS // 2
    torch.testing.assert_close(deeper[:, :-1, middle], frames()[:, 1:, middle], atol=1e-4, rtol=0.0)
    assert (deeper[:, :-1, 0] - frames()[:, 1:, 0]).abs().max() > 0.1

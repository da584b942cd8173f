"""Learning from a slice a step: which frame is whose turn, and where its pixels lie."""

import numpy as np
import pytest
import torch

from ultragray import ConvexProbe
from ultragray_studies.methods.learner import LearnedMethod
from ultragray_studies.methods.method import Budget
from ultragray_studies.methods.parts import SliceLearner, frame_of_step, pixel_points_mm
from ultragray_studies.methods.registry import METHODS

from .volumes import PROBE, along_elevation, seen

SLICE_METHODS = ("implicitvol", "implicitvol-refined", "rapidvol")
CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=20.0, far_mm=60.0)


def learner_of(name, probe=PROBE):
    method = METHODS[name]
    assert isinstance(method, LearnedMethod)
    dataset = seen(along_elevation(np.array([0.0, 2.0, 3.0])), (12, 8), probe)
    learner = method.learner(dataset, Budget.author(), 5, torch.device("cpu"))
    assert isinstance(learner, SliceLearner)
    return learner


def test_each_epoch_takes_each_frame_once_in_an_order_of_its_own():
    epochs = [[frame_of_step(7 * epoch + place, 7, seed=3) for place in range(7)] for epoch in range(4)]
    assert all(sorted(epoch) == list(range(7)) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) == 4
    assert epochs[0] != [frame_of_step(place, 7, seed=4) for place in range(7)]


@pytest.mark.parametrize("name", SLICE_METHODS)
def test_a_field_that_shows_the_image_has_no_loss(name, monkeypatch):
    learner = learner_of(name)
    place = frame_of_step(0, 3, seed=5)

    def image(points):
        return learner.image(place) + 0.0 * points.sum(dim=-1)

    monkeypatch.setattr(learner, "field", image)
    assert learner.loss(0, 10).item() == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("probe", [PROBE, CONVEX], ids=["linear", "convex"])
@pytest.mark.parametrize("name", SLICE_METHODS)
def test_a_frame_is_taken_at_the_places_of_its_pixels(name, probe, monkeypatch):
    learner = learner_of(name, probe)
    direction = torch.tensor([0.03, 0.02, 0.05])

    def ramp(points):
        return 0.5 + points @ direction

    monkeypatch.setattr(learner, "field", ramp)
    pose = learner.dataset.train.poses[1].copy()
    pose[:3, :3] = [[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]]
    frame = learner.render(probe, pose[None], 12, 8)[0]
    points = (pixel_points_mm(probe, pose, 12, 8) - learner.centre_mm) / learner.half_mm
    np.testing.assert_allclose(frame, 0.5 + points @ direction.numpy(), atol=2e-6)


@pytest.mark.parametrize("name", SLICE_METHODS)
def test_training_points_are_those_of_the_tracked_frames(name):
    learner = learner_of(name, CONVEX)
    for place, pose in enumerate(learner.dataset.train.poses):
        expected = (pixel_points_mm(CONVEX, pose, 12, 8) - learner.centre_mm) / learner.half_mm
        np.testing.assert_allclose(learner.training_points(place).detach().numpy(), expected, atol=2e-6)

"""The output `uncertainty`: its numbers in the scene, and what it says near the training views and far from them."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import LinearProbe, SceneInfo, render
from ultragray.errors import InvalidArgument, UnknownOutput
from ultragray.rendering.derived import CELLS, variance_terms
from ultragray.scene.confidence import DEPTHS, VARIANCE_TERMS, ConfidenceModel, DepthBands, Uncertainty

from .test_confidence import moved

PROBE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)
EACH = {"floor": 1.0, "level²": 0.02, "texture": 0.5, "gap 1 mm": 0.6, "beyond": 0.4, "thin": 0.05}
MODEL = Uncertainty(
    tuple(EACH.get(name, 0.0) for name in VARIANCE_TERMS), DepthBands((0.3,) * DEPTHS, (0.04,) * DEPTHS)
)


@pytest.fixture
def scene(random_scene):
    """Views at elevations of −1, 0 and 1 mm."""
    confidence = ConfidenceModel((3.5, 1.2, 0.8, 0.1, 0.6), 0.06, (0.0,) * 3, 20, 0.04, uncertainty=MODEL)
    made = random_scene(200, info={"probe": PROBE, "confidence": confidence.to_dict()})
    return replace(made, training_poses=moved(-1.0, 0.0, 1.0))


def shown(scene, poses, backend="auto", side=40):
    return render(scene, None, poses, height=side, width=side, outputs=("uncertainty",), backend=backend)["uncertainty"]


def test_it_grows_with_the_distance_to_the_views_and_ends_at_what_any_image_could_show(scene):
    frames = shown(scene, moved(0.0, 0.5, 3.0, 15.0, 500.0))
    means = frames.mean(dim=(1, 2)).tolist()
    assert means == sorted(means)
    assert 0.0 < means[0] < 0.5 * means[-1]
    nothing_there = (0.04 + 0.3**2) * (0.6 + 0.4 * (1.0 - np.exp(-20.0 / 5.0)) + 0.05) + 1e-3
    assert frames[-1].square() == pytest.approx(nothing_there, rel=1e-3)


@pytest.mark.parametrize("backend", ["cpu", pytest.param("cuda", marks=pytest.mark.slow)])
def test_every_backend_agrees_with_the_reference_in_float64(scene, backend, on_device):
    poses = moved(0.3, 4.0)
    poses[:, 0, 3] = 7.0
    found = shown(on_device(scene) if backend == "cuda" else scene, poses, backend)
    exact = shown(scene.to(torch.float64), poses, "reference")
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.cpu().double(), exact, atol=2e-3, rtol=0.0)


def test_another_size_says_the_same(scene):
    small, large = (shown(scene, moved(0.4), side=side).mean() for side in (40, 80))
    assert small == pytest.approx(float(large), rel=0.03)


def test_scenes_without_it_say_so(scene):
    known = ConfidenceModel.from_dict(scene.info.confidence)
    for confidence in ({}, replace(known, uncertainty=None).to_dict()):
        without = replace(scene, info=replace(scene.info, confidence=confidence))
        with pytest.raises(UnknownOutput, match="only for a scene whose training fitted its uncertainty") as caught:
            shown(without, moved(0.0))
        assert caught.value.field == "outputs"
    assert shown(scene, moved(0.0)).shape == (1, 40, 40)
    assert SceneInfo().confidence == {}


def test_terms_are_as_many_as_named_and_never_negative():
    planes = tuple(torch.rand(2, 24, 20, generator=torch.Generator().manual_seed(place)) for place in range(3))
    distances = (np.full((2, 12, 12), 0.7), np.full((2, 12, 12), 1.4))
    terms = list(variance_terms(planes, distances, MODEL.bands))
    assert len(terms) == len(VARIANCE_TERMS)
    assert all(term.shape == (2, 24, 20) and bool((term >= 0.0).all()) for term in terms)
    large = tuple(torch.rand(1, 100, 300) for _ in range(3))
    assert {term.shape for term in variance_terms(large, (np.ones((1, 12, 12)),) * 2, MODEL.bands)} == {
        (1, CELLS, CELLS)
    }


def test_json_and_back():
    document = json.loads(json.dumps(MODEL.to_dict(), allow_nan=False))
    assert Uncertainty.from_dict(document) == MODEL


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"variances": [1.0]}, f"variances must be {len(VARIANCE_TERMS)} numbers"),
        ({"level": [-1.0] * DEPTHS}, f"level must be {DEPTHS} numbers, at least 0"),
        ({"spread": [float("nan")] * DEPTHS}, "spread must be"),
        ({"spread": "much"}, "spread must be numbers"),
        ({"more": 1}, "with the keys"),
    ],
)
def test_damage_is_refused(change, said):
    with pytest.raises(InvalidArgument, match=said):
        Uncertainty.from_dict({**MODEL.to_dict(), **change})
    with pytest.raises(InvalidArgument, match="must be an object"):
        Uncertainty.from_dict(3)

"""The fit of the uncertainty: variances that are known are found again, and the far away is not forgotten."""

import numpy as np
import pytest

from ultragray import LinearProbe, render
from ultragray.datasets import Sweep
from ultragray.learn.training.confidence import fit_uncertainty, likeliest_variances
from ultragray.scene.confidence import DEPTHS, VARIANCE_TERMS, TrainingViews

PROBE = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)


def test_variances_are_found_again():
    rng = np.random.default_rng(0)
    terms = rng.uniform(0.0, 1.0, (20_000, 4))
    truth = np.array([0.02, 0.0, 0.3, 0.1])
    errors = rng.normal(0.0, np.sqrt(terms @ truth))
    found = likeliest_variances(terms, errors**2, np.ones(len(terms)))
    assert found == pytest.approx(truth, abs=0.02)
    assert (found >= 0.0).all()


def test_a_term_that_is_never_there_is_no_error():
    found = likeliest_variances(np.stack([np.ones(50), np.zeros(50)], axis=1), np.full(50, 0.04), np.ones(50))
    assert found[0] == pytest.approx(0.04)
    assert np.isfinite(found).all()


def test_errors_that_grow_away_from_the_views_do_so_in_the_model(random_scene):
    """The true frames are the scene's own, with noise that grows with elevation; the views lie at 0."""
    scene, rng = random_scene(150), np.random.default_rng(1)
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, 1, 3] = np.linspace(0.0, 4.0, 9)
    rendered = render(scene, PROBE, poses, height=32, width=32)["bmode"].numpy()
    noise = rng.normal(size=rendered.shape) * (0.02 + 0.04 * poses[:, 1, 3])[:, None, None]
    images = (255.0 * np.clip(0.5 * rendered + 0.3 + noise, 0.0, 1.0)).round().astype(np.uint8)
    sweep = Sweep(images, poses, PROBE, np.arange(9), "noisy")
    found = fit_uncertainty(scene, TrainingViews(poses[:1], PROBE), sweep, backend="auto")
    away = sum(found.variances[VARIANCE_TERMS.index(name)] for name in ("gap 0.3 mm", "gap 1 mm", "gap 3 mm", "beyond"))
    assert away > 0.1
    assert found.bands.level == pytest.approx([0.3 + 0.5 * rendered.mean()] * DEPTHS, abs=0.15)

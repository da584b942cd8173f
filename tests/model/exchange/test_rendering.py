"""Frames of many poses in one file, shown as asked, with an account of how."""

import errno
import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from ultragray import ConvexProbe, GaussianScene, render
from ultragray.contract import to_dict
from ultragray.errors import LowConfidence
from ultragray.exchange import rendering
from ultragray.exchange.exports.archives import NpzExporter
from ultragray.exchange.rendering import assess_by_rendering, render_to_file
from ultragray.rendering.confidence import supported_shares
from ultragray.rendering.display import Display
from ultragray.rendering.settings import Below, Resolved
from ultragray.samplers import TrainingSampler, assessed_poses
from ultragray.scene.confidence import SUPPORT_COVERAGE, Assessor, ConfidenceModel, Extrapolation, Support

PROBE = ConvexProbe(opening_angle_deg=60.0, near_mm=10.0, far_mm=50.0)
POSES = np.tile(np.eye(4), (5, 1, 1))
POSES[:, 1, 3] = np.arange(5)
CONFIDENCES = (0.2, 0.9, 0.2, 0.9, 0.9)


def settings(display, **more):
    return Resolved(probe=PROBE, height=24, width=20, outputs=("bmode", "coverage"), display=display, **more)


def written(path, scene, settings, **more):
    assessed = [Extrapolation(1.0, 1.0, confidence, None) for confidence in CONFIDENCES]
    return render_to_file(path, "npz", scene, settings, POSES, assessed, scene_name="one", scene_sha256="0", **more)


@pytest.mark.parametrize("display", [Display(), Display(depth_mm=20.0, flip=True), Display(pixel_mm=1.0)])
def test_a_file_tells_how_its_frames_are_shown(tmp_path, random_scene, monkeypatch, display):
    monkeypatch.setattr(rendering, "frames_at_once", lambda height, width: 2)
    scene, asked, done = random_scene(60), settings(display), []
    found, _ = written(tmp_path / "frames.npz", scene, asked, before_portion=done.append)
    assert done == [0, 2, 4, 5]
    coverage = render(scene, PROBE, POSES, height=24, width=20, outputs=("coverage",)).coverage
    shares = [one.supported_share for one in found]
    np.testing.assert_allclose(shares, (coverage.numpy() >= SUPPORT_COVERAGE).mean(axis=(1, 2)))
    with np.load(tmp_path / "frames.npz") as archive:
        assert archive["bmode"].shape == (5, asked.picture.height, asked.picture.width)
        for name in ("probe", "display", "picture"):
            assert json.loads(str(archive[name])) == to_dict(getattr(asked, name))


def test_pixels_without_support_are_black_where_they_are_masked(tmp_path, random_scene):
    asked = settings(Display(gain_db=20.0), min_confidence=0.5, below_min_confidence=Below.MASK)
    written(tmp_path / "frames.npz", random_scene(60), asked)
    with np.load(tmp_path / "frames.npz") as archive:
        for pixels, coverage, confidence in zip(archive["bmode"], archive["coverage"], CONFIDENCES, strict=True):
            unsupported = coverage < SUPPORT_COVERAGE
            assert unsupported.any()
            assert (pixels[unsupported] == 0.0).all() == (confidence < 0.5)


@pytest.fixture
def thin(random_scene):
    """A scene that knows its confidence: of its training poses above 0.8, of some of their frames below 0.5."""
    made = random_scene(60, info={"probe": PROBE})
    shares = supported_shares(render(made, PROBE, POSES, height=24, width=20, outputs=("coverage",))["coverage"])
    gain = 0.468 / float(shares.min() + shares.max()) * 2
    support = Support(gain, share=1.0 / gain, reach_mm=10.0)
    model = ConfidenceModel((3.5, 1.2, 0.8, 0.1, 0.6), 0.06, (0.0,) * len(POSES), 20, 0.04, support)
    info = replace(made.info, confidence=model.to_dict())
    return GaussianScene.from_splats(made.splats, info=info, training_poses=POSES)


def test_a_least_confidence_holds_for_what_a_frame_says_of_itself(thin, tmp_path):
    assess = partial(Assessor(thin.info, POSES).assess, probe=PROBE)
    coverage = render(thin, PROBE, POSES, height=24, width=20, outputs=("coverage",))["coverage"].numpy()
    rendered = np.array([one.confidence for one in assess(POSES, coverage=coverage)])
    assert min(one.confidence or 0.0 for one in assess(POSES)) > 0.8
    assert 0 < (rendered >= 0.5).sum() < len(POSES)

    asked = settings(Display(), min_confidence=0.5)
    options = {"scene_name": "one", "scene_sha256": "0"}
    first = int(np.argmin(rendered >= 0.5))
    with pytest.raises(LowConfidence, match=rf"poses\[{first}\] .* 0\.5 is asked for: .* Gaussians support \d+%"):
        render_to_file(tmp_path / "frames.npz", "npz", thin, asked, POSES, assess(POSES), **options)
    assert list(tmp_path.iterdir()) == []

    assess_frames = assess_by_rendering(thin, asked, assess)
    poses, found = assessed_poses(TrainingSampler(), POSES, PROBE, assess_frames, 0.5)
    np.testing.assert_array_equal(poses, POSES[rendered >= 0.5])
    render_to_file(tmp_path / "frames.npz", "npz", thin, asked, poses, found, **options)
    with np.load(tmp_path / "frames.npz") as archive:
        np.testing.assert_allclose(archive["confidence"], rendered[rendered >= 0.5])

    masking = settings(Display(), min_confidence=0.5, below_min_confidence=Below.MASK)
    render_to_file(tmp_path / "masked.npz", "npz", thin, masking, POSES, assess(POSES), **options)
    with np.load(tmp_path / "masked.npz") as archive:
        for pixels, some, confidence in zip(archive["bmode"], coverage, rendered, strict=True):
            assert (pixels[some < SUPPORT_COVERAGE] == 0.0).all() == (confidence < 0.5)


@pytest.mark.parametrize("failing", [1, len(CONFIDENCES)])
def test_a_portion_that_cannot_be_written_ends_it_and_leaves_nothing(tmp_path, random_scene, monkeypatch, failing):
    portions = 0

    def write(self, frames, count):
        nonlocal portions
        portions += 1
        if portions == failing:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(NpzExporter, "_write", write)
    monkeypatch.setattr(rendering, "frames_at_once", lambda height, width: 1)
    with pytest.raises(OSError, match="No space left"):
        written(tmp_path / "frames.npz", random_scene(3), settings(Display()))
    assert portions == failing
    assert list(tmp_path.iterdir()) == []

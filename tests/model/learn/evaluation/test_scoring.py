"""A scene measured on its own frames, in numbers that a script can read."""

import json
from dataclasses import replace

import numpy as np
import pytest

from ultragray import ConvexProbe, LinearProbe, render
from ultragray.datasets import Sweep
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.learn.evaluation import scoring as evaluation
from ultragray.learn.evaluation.metrics import frame_metrics
from ultragray.learn.evaluation.scoring import evaluate, evaluate_frames, render_sweep


@pytest.fixture(params=[LinearProbe(30.0, 0.0, 40.0), ConvexProbe(60.0, 10.0, 50.0)], ids=["linear", "convex"])
def probe(request):
    return request.param


@pytest.fixture
def scene(random_scene):
    return random_scene(80)


@pytest.fixture
def sweep(scene, probe, random_poses):
    """What the scene itself shows, in 8 bits."""
    poses = random_poses(5)
    frames = render(scene, probe, poses, height=24, width=20, outputs=("bmode",)).bmode
    assert frames is not None
    return Sweep((frames * 255).round().byte().numpy(), poses, probe, np.array([3, 7, 8, 20, 21]), "rendered")


def test_a_scene_meets_its_own_frames_up_to_their_8_bits(scene, sweep):
    reached = evaluate(scene, sweep)
    assert min(frame.psnr_db for frame in reached.frames) > 57.0
    assert reached.mean.ms_ssim > 0.999
    assert evaluate(scene, sweep, backend="reference").mean.psnr_db > 57.0


def test_frames_are_kept_apart_and_in_order(scene, sweep):
    images = sweep.images.copy()
    images[3] = np.clip(images[3].astype(int) + 20, 0, 255)
    reached = evaluate(scene, replace(sweep, images=images))
    assert int(np.argmin([frame.psnr_db for frame in reached.frames])) == 3
    assert reached.mean.psnr_db == pytest.approx(np.mean([frame.psnr_db for frame in reached.frames]))
    assert reached.std.psnr_db == pytest.approx(np.std([frame.psnr_db for frame in reached.frames]))


def test_as_json(scene, sweep):
    reached = evaluate(scene, sweep)
    document = json.loads(json.dumps(reached.to_dict(), allow_nan=False))
    assert document["mean"] == reached.mean.to_dict()
    assert document["std"] == reached.std.to_dict()
    assert document["ms_ssim_scales"] == 1
    assert [frame.pop("frame") for frame in document["frames"]] == [3, 7, 8, 20, 21]
    assert document["frames"] == [frame.to_dict() for frame in reached.frames]


def test_frames_are_rendered_and_measured_a_few_at_a_time(scene, sweep, monkeypatch):
    whole = evaluate(scene, sweep)
    predicted = render_sweep(scene, sweep)
    at_once = []

    def counted(rendered, truth):
        at_once.append(len(rendered))
        return frame_metrics(rendered, truth)

    monkeypatch.setattr(evaluation, "CHUNK_PIXELS", 2 * 24 * 20)
    monkeypatch.setattr(evaluation, "frame_metrics", counted)
    for measured in (evaluate(scene, sweep), evaluate_frames(predicted, sweep)):
        for frame, expected in zip(measured.frames, whole.frames, strict=True):
            assert frame.to_dict() == pytest.approx(expected.to_dict(), rel=1e-9)
    assert at_once == [2, 2, 1] * 2


def test_a_prediction_of_another_size_is_refused(sweep):
    with pytest.raises(InvalidArgument, match=r"be \[5, 24, 20\] like those of rendered, got \[6, 24, 20\]"):
        evaluate_frames(np.zeros((6, 24, 20), np.float32), sweep)


def test_nothing_to_measure_with(scene, sweep):
    with pytest.raises(DatasetInvalid, match="rendered: it holds no frames to measure with"):
        evaluate(scene, sweep.select([]))

"""A scene measured on its own frames, expected against actual errors, and pictures of both side by side."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from ultragray import ConvexProbe, LinearProbe, PhasedProbe, render
from ultragray.datasets import Sweep
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.learn.evaluation import scoring as evaluation
from ultragray.learn.evaluation.metrics import frame_metrics
from ultragray.learn.evaluation.scoring import (
    compare_deviations,
    evaluate,
    evaluate_frames,
    measure_reliability,
    render_sweep,
)
from ultragray.learn.evaluation.side_by_side import as_picture, side_by_side_panels, write_side_by_side
from ultragray.scene.confidence import DEPTHS, VARIANCE_TERMS, ConfidenceModel, DepthBands, Uncertainty


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


PROBE = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)
POSES = np.tile(np.eye(4), (4, 1, 1))


def drawn(spread):
    """Deviations of 100,000 pixels, and normal errors that are `spread` times as large."""
    rng = np.random.default_rng(0)
    deviations = rng.choice([0.015, 0.05, 0.2], 100_000).astype(np.float32)
    return (spread * deviations * rng.normal(size=100_000)).astype(np.float32), deviations


def test_what_holds():
    found = compare_deviations(*drawn(1.0))
    assert (found.within_1, found.within_2) == pytest.approx((0.683, 0.954), abs=0.01)
    assert found.actual == pytest.approx(found.expected, rel=0.02)
    assert [one.expected for one in found.bins] == pytest.approx([0.015, 0.05, 0.2])
    assert [one.actual for one in found.bins] == pytest.approx([0.015, 0.05, 0.2], rel=0.03)
    assert sum(one.share for one in found.bins) == pytest.approx(1.0)
    json.dumps(found.to_dict(), allow_nan=False)


def test_what_is_too_sure():
    found = compare_deviations(*drawn(2.0))
    assert found.within_1 == pytest.approx(0.383, abs=0.01)
    assert found.actual == pytest.approx(2.0 * found.expected, rel=0.02)


def test_of_a_scene(random_scene):
    floor = tuple(0.4 if name == "floor" else 0.0 for name in VARIANCE_TERMS)  # a variance of 0.4 times 0.001
    confidence = ConfidenceModel(
        (3.5, 1.2, 0.8, 0.1, 0.6),
        0.06,
        (0.0,) * 4,
        20,
        0.04,
        uncertainty=Uncertainty(floor, DepthBands((0.3,) * DEPTHS, (0.1,) * DEPTHS)),
    )
    made = random_scene(100, info={"probe": PROBE, "confidence": confidence.to_dict()})
    scene = replace(made, training_poses=POSES)
    frames = render(scene, PROBE, POSES, height=32, width=32)["bmode"].numpy()
    noise = np.random.default_rng(0).normal(0.0, 0.02, frames.shape)
    images = (255.0 * np.clip(frames + noise, 0.0, 1.0)).round().astype(np.uint8)
    sweep = Sweep(images, POSES, PROBE, np.arange(4), "noisy")
    found = measure_reliability(scene, sweep)
    assert found.expected == pytest.approx(0.02, rel=1e-3)
    assert found.actual == pytest.approx(0.02, rel=0.3)  # black pixels lose half of it
    assert measure_reliability(random_scene(20), sweep) is None
    with pytest.raises(DatasetInvalid, match="no frames to measure with"):
        measure_reliability(scene, sweep.select([]))


LINEAR = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=60.0)
CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=10.0, far_mm=50.0)
PHASED = PhasedProbe(opening_angle_deg=60.0, far_mm=50.0)


def random_sweep(probe, poses):
    images = np.random.default_rng(0).integers(0, 200, (len(poses), 24, 20), dtype=np.uint8)
    return Sweep(images, poses, probe, np.arange(len(poses)) + 40, "made")


@pytest.mark.parametrize("probe", [LINEAR, CONVEX, PHASED], ids=["linear", "convex", "phased"])
def test_one_picture_a_frame(tmp_path, random_scene, random_poses, probe):
    scene, sweep = random_scene(80), random_sweep(probe, random_poses(3))
    paths = write_side_by_side(scene, sweep, evaluate(scene, sweep).frames, tmp_path / "new" / "pictures")
    assert [path.name for path in paths] == ["frame_00040.png", "frame_00041.png", "frame_00042.png"]
    height, width = as_picture(sweep.images[0] / 255.0, sweep).shape
    for place, path in enumerate(paths):
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert picture.shape == (height + 44, 5 * width + 24)
        truth = as_picture((sweep.images[place] / 255.0).astype(np.float32), sweep)
        np.testing.assert_array_equal(picture[22 : 22 + height, :width], truth)
        assert (picture[:22] < 128).any()
        assert (picture[-22:] < 128).any()


def test_panels(random_scene, random_poses):
    scene, sweep = random_scene(80), random_sweep(LINEAR, random_poses(2))
    truth, rendering, difference, echo, transmittance = side_by_side_panels(scene, sweep).values()
    np.testing.assert_allclose(difference, np.minimum(3 * np.abs(rendering - truth), 1.0), atol=1e-6)
    np.testing.assert_allclose(rendering, echo * transmittance, atol=1e-5)
    np.testing.assert_array_equal(rendering, render_sweep(scene, sweep))


def test_a_picture_has_square_pixels():
    frame = np.zeros((24, 20), np.float32)
    frame[:12] = 1.0
    tall = as_picture(frame, random_sweep(LINEAR, np.eye(4)[None]), 100)
    assert tall.shape == (100, 50)
    assert tall[:45].min() == 255
    assert tall[55:].max() == 0
    wide = as_picture(frame, random_sweep(LinearProbe(60.0, 0.0, 30.0), np.eye(4)[None]), 100)
    assert wide.shape == (50, 100)

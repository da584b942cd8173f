"""The confidence that a training ends with: what is left out, what is fitted, and that it is true of others."""

from functools import lru_cache

import numpy as np
import pytest

from ultragray import GaussianScene, LinearProbe, render
from ultragray.errors import TrainingDiverged
from ultragray.learn.evaluation.scoring import evaluate, render_sweep
from ultragray.learn.sweep import Dataset, Sweep
from ultragray.learn.training import TrainingConfig, confidence, run, train
from ultragray.learn.training.confidence import (
    BEYOND_MM,
    GAIN_QUANTILE,
    LEAST_KEPT,
    MAX_SHARE,
    PRIOR_WEIGHTS,
    STRETCHES,
    TURNED,
    Examples,
    fit_confidence,
    fit_support,
    fit_uncertainty,
    fit_weights,
    hardness_of_views,
    held_out_frames,
    likeliest_variances,
    one_sided,
    one_sided_examples,
    shorter,
)
from ultragray.learn.training.geometry import Geometry
from ultragray.phantom import PHANTOM_PROBE, freehand_poses, simulate
from ultragray.scene.confidence import (
    DEPTHS,
    DISTANCE_MM,
    VARIANCE_TERMS,
    Assessor,
    TrainingViews,
    ViewMeasures,
    predicted,
)

SIDE = 64


def simulated(poses):
    images = simulate(poses, probe=PHANTOM_PROBE, height=SIDE, width=SIDE)
    return Sweep(images, poses, PHANTOM_PROBE, np.arange(len(poses)), "phantom")


@lru_cache
def phantom() -> tuple[Dataset, Sweep]:
    """A straight sweep with a gap and without its last third, and frames in the gap, tilted, and off the end."""
    poses = freehand_poses(46)
    along = poses[:, 1, 3]
    train_poses = poses[(along < 18.0) & ~((along > -14.0) & (along < -7.0))]
    others = freehand_poses(120, tilt_deg=6.0, unrest=1.0)[::8], freehand_poses(120, unrest=2.0)[4::8]
    val = np.concatenate(others)
    dataset = Dataset("phantom", simulated(train_poses), simulated(val))
    return dataset, dataset.val


@lru_cache
def trained() -> GaussianScene:
    dataset, _ = phantom()
    return train(dataset, TrainingConfig.preset("fast", steps=120, max_gaussians=4_000))


def ranks(values):
    return values.argsort().argsort().astype(np.float64)


@pytest.mark.long
def test_it_tells_what_frames_will_reach():
    scene, (_, val) = trained(), phantom()
    actual = np.array([frame.ms_ssim for frame in evaluate(scene, val).frames])
    told = np.array([frame.confidence for frame in Assessor(scene.info, scene.training_poses).assess(val.poses)])
    assert actual.std() > 0.1
    assert np.corrcoef(ranks(told), ranks(actual))[0, 1] > 0.8
    assert np.abs(told - actual).mean() < 0.1


def test_nothing_of_what_is_left_out_is_trained_from(tiny_dataset):
    dataset, parts = tiny_dataset(frames=24), []

    def train_part(part):
        parts.append(part)
        settings = {"steps": 5, "max_gaussians": 50, "confidence": False, "refine_poses": "none"}
        return train(part, TrainingConfig.preset("fast", **settings))

    model = fit_confidence(dataset, train_part, backend="auto")
    (part,) = parts
    assert len(part.train) + model.fitted_on == len(dataset.train)
    assert set(part.train.frame_numbers) < set(dataset.train.frame_numbers)
    assert len(part.val) == 0


@pytest.mark.parametrize(("steps", "fewer_steps"), [(2_001, 501), (400, 375), (24, 24)])
def test_a_quarter_of_the_steps_and_fewer_gaussians(tiny_dataset, tiny_config, steps, fewer_steps):
    config = tiny_config(steps=steps).resolved(Geometry.of(tiny_dataset()))
    fewer = shorter(config, 0.6)
    assert (fewer.steps, fewer.max_gaussians, fewer.initial_gaussians) == (fewer_steps, 36, 18)
    assert fewer.out_of_plane_mm == config.out_of_plane_mm


@pytest.mark.long
def test_it_can_be_left_out(tiny_dataset, tiny_config):
    dataset = tiny_dataset(frames=40)
    without = train(dataset, tiny_config())
    assert without.info.confidence == {}
    having = train(dataset, tiny_config(confidence=True))
    assert having.info.confidence["version"] == 2
    assert len(having.info.confidence["uncertainty"]["variances"]) == len(VARIANCE_TERMS)
    assert having.means.equal(without.means)


@pytest.mark.long
def test_the_time_left_holds_the_fit_and_the_fit_is_told(tiny_dataset, tiny_config):
    seen = []
    train(tiny_dataset(frames=40), tiny_config(confidence=True), report=seen.append)
    own = [progress for progress in seen if progress.beside is None]
    fit = [progress for progress in seen if progress.beside == run.FITTING]
    assert seen == own + fit
    assert fit[-1].step == fit[-1].steps > 0
    steps_left = [progress.seconds_left * progress.steps_per_s for progress in own]
    later = steps_left[-1]
    assert 0.5 * fit[-1].steps <= later <= fit[-1].steps
    assert steps_left == pytest.approx([own[-1].steps - progress.step + later for progress in own])


def test_too_few_frames_give_none(tiny_dataset, tiny_config):
    assert train(tiny_dataset(frames=6), tiny_config(confidence=True)).info.confidence == {}


def test_a_calibration_that_diverges_costs_no_scene(tiny_dataset, tiny_config, monkeypatch, caplog):
    def diverge(*_, **__):
        raise TrainingDiverged("training diverged in step 3: the loss is nan")

    monkeypatch.setattr(run, "fit_confidence", diverge)
    scene = train(tiny_dataset(frames=40), tiny_config(confidence=True, refine_poses="none"))
    assert scene.info.confidence == {}
    assert "the scene gets no confidence: training diverged in step 3" in caplog.text


@pytest.mark.long
def test_it_tells_the_errors_of_pixels():
    scene, (_, val) = trained(), phantom()
    bmode, uncertainty = (render_sweep(scene, val, output=output) for output in ("bmode", "uncertainty"))
    errors = np.abs(val.images / 255.0 - bmode)
    assert 0.5 < np.sqrt((uncertainty**2).mean()) / np.sqrt((errors**2).mean()) < 2.0
    sure, unsure = (errors[chosen].mean() for chosen in (uncertainty < 0.1, uncertainty > 0.2))
    assert unsure > 2.0 * sure
    assert 0.85 < (errors <= 2.0 * uncertainty).mean() < 0.995


def test_support_is_fitted_so_that_most_frames_keep_to_it():
    distances = np.linspace(0.0, 6.0, 100)
    away = ViewMeasures(*(distances[:, None],) * 3, np.zeros((100, 1)), np.ones((100, 1)))
    shares = 0.8 * np.exp(-np.square(distances / 3.0))
    gains = np.random.default_rng(0).permutation(np.linspace(1.0, 2.0, 100))
    found = fit_support(away, shares, 0.1 + 0.9 * gains * np.maximum(shares, 0.02), 0.1)
    assert found.gain == pytest.approx(1.0 + GAIN_QUANTILE, abs=0.02)
    assert (found.share, found.reach_mm) == pytest.approx((0.8, 3.0), rel=0.05)
    assert fit_support(away, np.ones(100), np.full(100, 0.6), 0.1).gain == 1.0


def test_views_decide_the_weights():
    rng = np.random.default_rng(0)
    terms = np.concatenate([np.ones((400, 5, 1)), -rng.uniform(0.0, 2.0, (400, 5, 4))], axis=2)
    truth = np.array([2.5, 0.4, 2.0, 0.8, 0.0])
    fitted = fit_weights(Examples(terms, predicted(truth, terms, 0.1)), 0.1)
    assert np.abs(predicted(fitted, terms, 0.1) - predicted(truth, terms, 0.1)).mean() < 0.02
    assert fitted[2] > 1.5 > 0.8 > fitted[1]


def test_no_weight_turns_negative_though_the_views_say_so():
    distances = np.linspace(0.0, 2.0, 500)
    terms = np.column_stack([np.ones(500), -distances, *np.zeros((3, 500))])[:, None]
    fitted = fit_weights(Examples(terms, 0.3 + 0.3 * distances), 0.05)
    assert fitted[1] == 0.0
    assert predicted(fitted, terms, 0.05).std() < 1e-12


def along_a_line(distances, weights):
    """Frames with only a constant and one term, that reach what these two weights tell."""
    terms = np.column_stack([np.ones_like(distances), -distances, *np.zeros((3, len(distances)))])[:, None]
    return Examples(terms, predicted(np.array([*weights, 0.0, 0.0, 0.0]), terms, 0.05))


def test_interpolated_frames_tell_how_scores_fall_and_not_how_high_they_are():
    rendered = along_a_line(np.zeros(60), (2.0, 0.0))  # all at one place: they leave the slope open
    worse_and_falling = along_a_line(np.linspace(0.0, 2.0, 300), (1.0, 3.0))
    without, fitted = fit_weights(rendered, 0.05), fit_weights(rendered, 0.05, worse_and_falling)
    assert without[1] == pytest.approx(PRIOR_WEIGHTS[1])
    assert 0.5 * (PRIOR_WEIGHTS[1] + 3.0) < fitted[1] < 3.1  # more than half of the way from the prior
    assert fitted[0] == pytest.approx(2.0, abs=0.3)


PROBE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=40.0)


def changing_sweep(count, side):
    """The same texture in the first half of the frames, another in each frame of the second."""
    rng = np.random.default_rng(1)
    coarse = rng.integers(0, 255, (count, 16, 16))
    coarse[: count // 2] = coarse[0]
    images = np.kron(coarse, np.ones((side // 16, side // 16))).astype(np.uint8)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 1, 3] = 1.5 * np.arange(count)
    return Sweep(images, poses, PROBE, np.arange(count), "test")


@pytest.mark.long
@pytest.mark.parametrize("side", [32, 128])
def test_hard_is_where_neighbours_do_not_tell(side):
    sweep = changing_sweep(24, side)
    hardness = hardness_of_views(sweep, one_sided(sweep))
    assert hardness.shape == (24,)
    assert hardness[:9].max() < -1.0 < 1.0 < hardness[15:].min()


def test_predictions_are_the_same_however_many_are_made_at_once(monkeypatch):
    sweep = changing_sweep(8, 32)
    found = []
    for at_once in (confidence.PREDICTED_AT_ONCE, 3, 1):
        monkeypatch.setattr(confidence, "PREDICTED_AT_ONCE", at_once)
        found.append([(one.target, one.is_nearest, one.ms_ssim) for one in one_sided(sweep)])
    assert len(found[0]) > 8
    assert found[0] == found[1] == found[2]


def test_a_gap_is_hard_where_its_edges_differ():
    """A texture that drifts sideways, evenly but for a gap of 8 mm; behind that either the same one or another."""
    textures = np.random.default_rng(1).integers(0, 255, (2, 8, 15))
    alike, different = (np.kron(textures[[0, other]], np.ones((8, 16), int)).astype(np.uint8) for other in (0, 1))
    poses = np.tile(np.eye(4), (16, 1, 1))
    poses[:, 1, 3] = np.arange(16) + np.repeat([0.0, 7.0], 8)
    found = []
    for texture in (alike, different):
        images = np.stack(
            [np.roll(texture[place // 8], round(y), axis=1)[:, :64] for place, y in enumerate(poses[:, 1, 3])]
        )
        sweep = Sweep(images, poses, PROBE, np.arange(16), "test")
        found.append(hardness_of_views(sweep, one_sided(sweep)))
    of_alike, of_different = found
    assert of_different[[7, 8]].min() > of_alike[[7, 8]].max() + 0.5
    assert of_different[[7, 8]].min() > of_different[[2, 13]].max() + 0.5


def sweep_at(poses):
    images = np.random.default_rng(0).integers(0, 255, (len(poses), 4, 4)).astype(np.uint8)
    return Sweep(images, poses, PROBE, np.arange(len(poses)), "test")


def straight(count):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 1, 3] = np.linspace(0.0, 60.0, count)
    return poses


def test_ends_and_gaps_of_several_widths_are_left_out():
    held_out = held_out_frames(sweep_at(straight(101)))
    path = held_out / 100.0
    path = path if path[0] == 0.0 and path[6] == 0.06 and path[7] > 0.06 else 1.0 - path  # either end may be the first
    for first, last in STRETCHES:
        inside = (path > first - 1e-9) & (path < last + 1e-9)
        assert inside.sum() == pytest.approx(round(100 * last) - round(100 * first) + 1, abs=1)  # an edge may round
    outside = [x for x in path if not any(first - 1e-9 < x < last + 1e-9 for first, last in STRETCHES)]
    assert 3 <= len(outside) <= 12  # single ones
    assert len(held_out) <= MAX_SHARE * 101


def test_the_most_tilted_frames_of_a_stretch_are_left_out():
    poses = np.concatenate([freehand_poses(60, tilt_deg=tilt) for tilt in (-8.0, 0.0, 8.0)])
    sweep = sweep_at(poses)
    held_out = held_out_frames(sweep)
    middles = sweep.corners_mm().mean(axis=1)[:, 1]
    path = (middles - middles.min()) / np.ptp(middles)
    best = 0.0
    for along in (path, 1.0 - path):
        inside = (along > TURNED[0]) & (along < TURNED[1])
        tilts = np.arange(180)[inside] // 60
        left_out = np.isin(np.arange(180)[inside], held_out)
        shares = [left_out[tilts == tilt].mean() for tilt in (0, 2)]
        best = max(best, abs(shares[0] - shares[1]))
    assert best > 0.6


@pytest.mark.parametrize("count", [2, 3, 5, 8, 12])
def test_few_frames_are_left_enough_of(count):
    held_out = held_out_frames(sweep_at(straight(count)))
    assert count - len(held_out) >= min(count, LEAST_KEPT)
    assert len(held_out) <= MAX_SHARE * count


STEP_MM = 1.0
FRAMES = 18


def drifting_sweep(count, columns_per_frame):
    """Parallel frames of one texture that shifts sideways from each to the next."""
    texture = np.kron(np.random.default_rng(1).integers(0, 255, (8, 60)), np.ones((8, 4), int)).astype(np.uint8)
    images = np.stack([np.roll(texture, columns_per_frame * frame, axis=1)[:, :64] for frame in range(count)])
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 1, 3] = STEP_MM * np.arange(count)
    return Sweep(images, poses, PROBE, np.arange(count), "test")


def examples_of(sweep):
    """All equally hard."""
    return one_sided_examples(sweep, one_sided(sweep), np.zeros(len(sweep)))


def test_each_frame_is_predicted_from_either_side_and_ever_farther_away():
    examples = examples_of(drifting_sweep(FRAMES, 1))
    distances = -examples.terms[:, 0, 2] * DISTANCE_MM
    assert sorted(set(distances.round(3))) == [1.0, 2.0, 4.0, 6.0, 9.0, 13.0]  # one step beyond each of BEYOND_MM
    assert len(BEYOND_MM) == 6
    nearest_frames = 2 * (FRAMES - 2)  # with at least two frames on that side
    assert (distances.round(3) == 1.0).sum() == nearest_frames


def test_scores_fall_with_distance_where_anatomy_changes_and_only_there():
    for columns_per_frame, falls in ((1, True), (0, False)):
        examples = examples_of(drifting_sweep(12, columns_per_frame))
        distances = -examples.terms[:, 0, 2] * DISTANCE_MM
        near, far = (examples.ms_ssim[chosen].mean() for chosen in (distances < 1.5, distances > 8.0))
        assert (near - far > 0.2) if falls else (near == pytest.approx(far, abs=1e-6))


NARROW_PROBE = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)


def test_variances_are_found_again():
    rng = np.random.default_rng(0)
    terms = rng.uniform(0.0, 1.0, (20_000, 4))
    truth = np.array([0.02, 0.0, 0.3, 0.1])
    errors = rng.normal(0.0, np.sqrt(terms @ truth))
    found = likeliest_variances(terms, errors**2, np.ones(len(terms)))
    assert found == pytest.approx(truth, abs=0.02)
    assert (found >= 0.0).all()


def test_errors_that_grow_away_from_the_views_do_so_in_the_model(random_scene):
    """The true frames are the scene's own, with noise that grows with elevation; the views lie at 0."""
    scene, rng = random_scene(150), np.random.default_rng(1)
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, 1, 3] = np.linspace(0.0, 4.0, 9)
    rendered = render(scene, NARROW_PROBE, poses, height=32, width=32)["bmode"].numpy()
    noise = rng.normal(size=rendered.shape) * (0.02 + 0.04 * poses[:, 1, 3])[:, None, None]
    images = (255.0 * np.clip(0.5 * rendered + 0.3 + noise, 0.0, 1.0)).round().astype(np.uint8)
    sweep = Sweep(images, poses, NARROW_PROBE, np.arange(9), "noisy")
    found = fit_uncertainty(scene, TrainingViews(poses[:1], NARROW_PROBE), sweep, backend="auto")
    away = sum(found.variances[VARIANCE_TERMS.index(name)] for name in ("gap 0.3 mm", "gap 1 mm", "gap 3 mm", "beyond"))
    assert away > 0.1
    assert found.bands.level == pytest.approx([0.3 + 0.5 * rendered.mean()] * DEPTHS, abs=0.15)

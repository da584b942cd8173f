"""TrainingConfig: presets, overrides, one sentence for what cannot be; the effort that a training chooses itself."""

from dataclasses import replace

import pytest

from ultragray.errors import InvalidArgument, MemoryExceeded
from ultragray.learn.evaluation.metrics import FrameMetrics
from ultragray.learn.training import Progress, TrainingConfig, train
from ultragray.learn.training.checkpointing import read_checkpoint_header
from ultragray.learn.training.config import (
    VIEWS_BETWEEN,
    parse_value,
    read_config_file,
    scaled_transmittance_rate,
)
from ultragray.learn.training.geometry import Geometry
from ultragray.learn.training.run import EFFORTS_FILE, choose_effort
from ultragray.learn.training.trainer import CHECKPOINT_FILE


def test_presets():
    paper = TrainingConfig.preset("paper")
    assert (paper.steps, paper.max_gaussians, paper.initial_gaussians) == (30_000, 500_000, 500_000)
    assert (paper.intensity, paper.start, paper.out_of_plane_mm) == ("released", "random", 2.0)
    assert TrainingConfig.preset("fast") == TrainingConfig()
    with pytest.raises(InvalidArgument, match="preset must be one of fast, best, paper, got 'slow'"):
        TrainingConfig.preset("slow")


def test_more_effort_is_more_steps_and_gaussians_unless_they_are_given(tiny_dataset):
    geometry = Geometry.of(tiny_dataset())
    usual, thrice = (TrainingConfig(effort=effort).resolved(geometry) for effort in (1.0, 3.0))
    assert (thrice.steps, thrice.max_gaussians) == (3 * (usual.steps or 0), 3 * (usual.max_gaussians or 0))
    given = TrainingConfig(effort=3.0, steps=7, max_gaussians=50).resolved(geometry)
    assert (given.steps, given.max_gaussians) == (7, 50)
    assert TrainingConfig.preset("best").resolved(geometry) == usual  # the effort is chosen before, see below


def test_half_of_the_gaussians_start_where_only_the_end_is_given(tiny_dataset):
    geometry = Geometry.of(tiny_dataset())
    assert TrainingConfig.preset("paper", max_gaussians=60_000).resolved(geometry).initial_gaussians == 30_000
    assert TrainingConfig.preset("paper", max_gaussians=60_000, initial_gaussians=7).initial_gaussians == 7


def test_frames_however_far_apart_shift_a_batch_by_at_most_ten_centimetres(tiny_dataset):
    geometry = replace(Geometry.of(tiny_dataset()), out_of_plane_mm=500.0)
    assert TrainingConfig().resolved(geometry).out_of_plane_mm == 100.0


def test_what_is_left_open_follows_from_the_data(tiny_dataset):
    geometry = Geometry.of(tiny_dataset())
    config = TrainingConfig().resolved(geometry)
    assert config.steps == geometry.steps(VIEWS_BETWEEN)
    assert config.max_gaussians == config.initial_gaussians == geometry.gaussian_count(VIEWS_BETWEEN)
    assert config.initial_scale_mm == geometry.initial_scale_mm
    assert config.initial_elevation_mm == geometry.initial_elevation_mm(geometry.out_of_plane_mm)
    assert config.out_of_plane_mm == geometry.out_of_plane_mm
    given = TrainingConfig(max_gaussians=9, out_of_plane_mm=0.0, initial_scale_mm=2.0)
    resolved = given.resolved(geometry)
    assert (resolved.max_gaussians, resolved.initial_gaussians, resolved.initial_scale_mm) == (9, 9, 2.0)
    assert resolved.out_of_plane_mm == 0.0
    assert resolved.resolved(geometry) == resolved


def test_a_step_has_whole_views_between_frames_and_one_frame_at_least(tiny_dataset):
    geometry = Geometry.of(tiny_dataset())
    for batch_size, asked, found in ((8, 0.75, 0.75), (1, 0.75, 0.0), (8, 1.0, 0.875), (4, 0.1, 0.0)):
        config = TrainingConfig(batch_size=batch_size, views_between=asked).resolved(geometry)
        assert config.views_between == found
        assert config.steps == geometry.steps(found)


def test_an_unknown_setting_is_refused_with_the_known_ones():
    with pytest.raises(
        InvalidArgument, match=r"no setting stepz; it has steps, effort, batch_size, .*, memory_gb"
    ) as caught:
        TrainingConfig.preset("fast", stepz=3)
    assert caught.value.field == "stepz"


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"batch_size": None}, "batch_size must be an integer from 1 to 1024, got null"),
        ({"means_rate": float("nan")}, "means_rate must be a finite number from 0 to 1, got nan"),
        ({"out_of_plane_mm": "wide"}, "out_of_plane_mm must be a finite number from 0 to 100, got 'wide'"),
        ({"intensity": "linear"}, "intensity must be one of released, sigmoid, got 'linear'"),
        ({"max_gaussians": 5, "initial_gaussians": 6}, "initial_gaussians must be at most max_gaussians (5), got 6"),
    ],
)
def test_refuses(settings, sentence):
    with pytest.raises(InvalidArgument) as caught:
        TrainingConfig.preset("fast", **settings)
    assert caught.value.detail == sentence
    assert caught.value.field in sentence


def test_file(tmp_path):
    path = tmp_path / "run.toml"
    path.write_text('preset = "paper"\nsteps = 100\nmeans_rate = 1e-4\n')
    assert read_config_file(path) == {"preset": "paper", "steps": 100, "means_rate": 1e-4}
    path.write_text("steps = = 1")
    with pytest.raises(InvalidArgument, match=r"run\.toml: not a TOML file: "):
        read_config_file(path)
    path.write_text("[rates]\nmeans = 1")
    with pytest.raises(InvalidArgument, match=r"run\.toml: settings stand by themselves, not in a table \[rates\]"):
        read_config_file(path)


def test_values():
    values = [parse_value(text) for text in ("3", "1e-4", "true", "random", '"random"', "")]
    assert values == [3, 1e-4, True, "random", "random", ""]


@pytest.mark.parametrize(("steps", "rate"), [(60_000, 5e-4), (30_000, 5e-4), (3_000, 5e-3), (500, 2e-2)])
def test_short_runs_of_the_released_recipe_let_shadows_form(steps, rate):
    assert scaled_transmittance_rate(steps) == pytest.approx(rate)


OPEN = TrainingConfig(effort=None, max_gaussians=60, batch_size=3)


def metrics(rank):
    """Better in everything for a higher rank."""
    return FrameMetrics(psnr_db=20.0 + rank, ms_ssim=0.8 + rank / 100, gms=0.9 + rank / 100, gmsd=0.15 - rank / 100)


class TryOut:
    """Scores by effort, of a training that is not done; keeps what was asked for."""

    def __init__(self, ranks):
        self.ranks, self.asked = ranks, list[float]()

    def __call__(self, part, config):
        assert len(part.train)
        assert len(part.val) >= 3
        assert not config.confidence
        self.asked.append(config.effort)
        return metrics(self.ranks[config.effort])


@pytest.mark.parametrize(
    ("ranks", "chosen", "asked"),
    [
        ({1.0: 0.0, 2.0: -1.0, 0.5: -1.0}, 1.0, [1.0, 2.0, 0.5]),
        ({1.0: 0.0, 2.0: 1.0, 3.0: 2.0}, 3.0, [1.0, 2.0, 3.0]),
        ({1.0: 0.0, 2.0: 1.0, 3.0: 0.5}, 2.0, [1.0, 2.0, 3.0]),
        ({1.0: 0.0, 2.0: -1.0, 0.5: 1.0, 0.25: 0.0}, 0.5, [1.0, 2.0, 0.5, 0.25]),
        ({1.0: 0.0, 2.0: 0.0, 0.5: 0.0}, 1.0, [1.0, 2.0, 0.5]),
    ],
)
def test_the_best_effort_is_looked_for_upwards_then_downwards(tiny_dataset, ranks, chosen, asked):
    try_out = TryOut(ranks)
    assert choose_effort(tiny_dataset(frames=40), OPEN, try_out, None) == chosen
    assert try_out.asked == asked


@pytest.mark.parametrize("name", ["psnr_db", "ms_ssim", "gms", "gmsd"])
def test_an_effort_that_is_worse_in_one_metric_is_not_better(name):
    better = metrics(1.0)
    assert better.is_better_than(metrics(0.0))
    assert not replace(better, **{name: getattr(metrics(-1.0), name)}).is_better_than(metrics(0.0))
    assert not better.is_better_than(better)


def test_what_was_found_is_not_tried_again_in_the_same_run(tiny_dataset, tmp_path):
    dataset, folder = tiny_dataset(frames=40), tmp_path / "run"
    ranks = {1.0: 0.0, 2.0: 1.0, 3.0: 0.5}
    interrupted = TryOut(ranks)

    def try_out(part, config):
        return None if len(interrupted.asked) > 1 else interrupted(part, config)

    assert choose_effort(dataset, OPEN, try_out, folder) is None
    assert interrupted.asked == [1.0, 2.0]
    again = TryOut(ranks)
    assert (choose_effort(dataset, OPEN, again, folder), again.asked) == (2.0, [3.0])
    other = TryOut(ranks)
    choose_effort(dataset, replace(OPEN, seed=1), other, folder)
    assert other.asked == [1.0, 2.0, 3.0]
    (folder / EFFORTS_FILE).write_text("{")
    damaged = TryOut(ranks)
    choose_effort(dataset, OPEN, damaged, folder)
    assert damaged.asked == [1.0, 2.0, 3.0]


def test_an_effort_that_the_memory_does_not_allow_is_not_chosen(tiny_dataset, caplog):
    usual = TryOut({1.0: 0.0, 0.5: -1.0})

    def try_out(part, config):
        if config.effort == 2.0:
            raise MemoryExceeded("too many Gaussians")
        return usual(part, config)

    assert choose_effort(tiny_dataset(frames=40), OPEN, try_out, None) == 1.0
    assert "effort 2 cannot be tried: too many Gaussians" in caplog.text


def trying(effort):
    return f"trying effort {effort:g} on a part of the frames"


def test_a_run_whose_choice_is_stopped_goes_on_with_it(tiny_dataset, tmp_path):
    dataset, seen = tiny_dataset(frames=40), list[Progress]()
    config = TrainingConfig(effort=None, steps=12, batch_size=3, confidence=False, refine_poses="none")
    stopped = train(
        dataset, config, folder=tmp_path, report=seen.append, should_stop=lambda: seen[-1].beside == trying(2.0)
    )
    assert (stopped.info.training["step"], stopped.info.training["steps"]) == (0, 12)
    assert not (tmp_path / CHECKPOINT_FILE).exists()
    rest = list[Progress]()
    train(dataset, config, folder=tmp_path, report=rest.append, should_stop=lambda: rest[-1].beside is None)
    assert trying(1.0) not in [progress.beside for progress in rest]
    effort = read_checkpoint_header(tmp_path / CHECKPOINT_FILE).config.effort
    whole = train(dataset, config, folder=tmp_path, resume=True)
    assert whole.to_bytes() == train(dataset, replace(config, effort=effort)).to_bytes()

"""The effort of a training that leaves it open: chosen on frames left out, once, whatever interrupts the choice."""

from dataclasses import replace

import pytest

from ultragray.errors import MemoryExceeded
from ultragray.learn.evaluation.metrics import FrameMetrics
from ultragray.learn.training import Progress, TrainingConfig, train
from ultragray.learn.training.checkpointing import read_checkpoint_header
from ultragray.learn.training.run import EFFORTS_FILE, FITTING, choose_effort
from ultragray.learn.training.trainer import CHECKPOINT_FILE

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
        assert config.effort is not None
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


@pytest.mark.long
def test_a_run_chooses_first_and_says_so(tiny_dataset, tmp_path):
    dataset, seen = tiny_dataset(frames=40), list[Progress]()
    config = TrainingConfig(effort=None, steps=12, batch_size=3)
    scene = train(dataset, config, folder=tmp_path, report=seen.append)
    chosen = scene.info.training["effort"]
    told = list(dict.fromkeys(progress.beside for progress in seen))
    assert told[:2] == [trying(1.0), trying(2.0)]
    assert told[-2:] == [None, FITTING]
    assert trying(chosen) in told
    assert [progress.step for progress in seen if progress.beside is None][-1] == 12
    assert scene.to_bytes() == train(dataset, replace(config, effort=chosen)).to_bytes()


def test_a_run_whose_choice_is_stopped_goes_on_with_it(tiny_dataset, tmp_path):
    dataset, seen = tiny_dataset(frames=40), list[Progress]()
    config = TrainingConfig(effort=None, steps=12, batch_size=3, confidence=False)
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

"""TensorBoard shows the journal's numbers, each step once."""

import sys

import pytest

from ultragray.errors import InvalidArgument
from ultragray.learn.training.progress import Board


def shown(folder, name):
    """Steps and values as TensorBoard's own reader finds them."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder))
    events.Reload()
    return [(event.step, pytest.approx(event.value)) for event in events.Scalars(name)]


def write(folder, losses, *, steps_done):
    board = Board(folder, steps_done=steps_done)
    for step, loss in losses.items():
        board.write({"step": step, "loss": loss, "gaussians": 60})
    board.close()


def test_a_resumed_run_hides_the_steps_that_it_takes_again(tmp_path):
    pytest.importorskip("tensorboard", reason="the extra tensorboard is not installed")
    write(tmp_path, {1: 0.5, 2: 0.25, 3: 0.125}, steps_done=0)
    write(tmp_path, {2: 0.75, 3: 0.625}, steps_done=1)
    assert shown(tmp_path, "loss") == [(1, 0.5), (2, 0.75), (3, 0.625)]


def test_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(InvalidArgument, match=r"TensorBoard is not installed: .*'ultragray\[tensorboard\]'"):
        Board(tmp_path, steps_done=0)

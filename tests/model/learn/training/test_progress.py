"""The journal never holds a step twice; TensorBoard shows its numbers."""

import json
import sys

import pytest

from ultragray.errors import InvalidArgument
from ultragray.learn.training.progress import Board, Journal, StepTimer


def steps_in(path):
    return [json.loads(line)["step"] for line in path.read_text().splitlines()]


def test_lines_are_there_at_once(tmp_path):
    journal = Journal(tmp_path / "metrics.jsonl", steps_done=0)
    journal.write({"step": 1, "loss": 0.5})
    assert steps_in(tmp_path / "metrics.jsonl") == [1]
    journal.close()


def test_goes_on_after_the_checkpoint(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text("".join(f'{{"step": {step}}}\n' for step in range(1, 6)) + '{"step": 6, "lo')
    journal = Journal(path, steps_done=3)
    journal.write({"step": 4})
    journal.close()
    assert steps_in(path) == [1, 2, 3, 4]
    Journal(path, steps_done=0).close()
    assert steps_in(path) == []


def test_half_a_line_is_dropped(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"step": 1}\n{"step": 2')
    Journal(path, steps_done=9).close()
    assert steps_in(path) == [1]


@pytest.mark.parametrize(
    "damage", [b"{nonsense\n", b"\xff\xfe\n", b"3\n", b'{"loss": 0.5}\n', b'{"step": null}\n', b"\0" * 9]
)
def test_a_damaged_line_ends_what_is_kept(tmp_path, damage):
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(b'{"step": 1}\n' + damage + b'{"step": 3}\n')
    journal = Journal(path, steps_done=9)
    journal.write({"step": 10})
    journal.close()
    assert steps_in(path) == [1, 10]


def test_timer():
    timer = StepTimer(elapsed_s=10.0)
    assert timer.rate() == 0.0
    timer.add(0.5)
    timer.add(0.5)
    assert timer.rate() == pytest.approx(2.0)
    assert timer.elapsed_s == pytest.approx(11.0)


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

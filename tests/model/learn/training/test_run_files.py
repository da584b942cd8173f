"""Files of a run: a journal that never holds a step twice, TensorBoard, checkpoints that are whole and of one run."""

import json
import math
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from ultragray.errors import TrainingStateInvalid
from ultragray.learn.training import TrainingConfig
from ultragray.learn.training.checkpointing import (
    FORMAT_VERSION,
    METADATA_KEY,
    CheckpointHeader,
    check_same_run,
    read_checkpoint,
    read_checkpoint_header,
    write_checkpoint,
)
from ultragray.learn.training.progress import Board, Journal, StepTimer


def steps_in(path):
    return [json.loads(line)["step"] for line in path.read_text().splitlines()]


def test_goes_on_after_the_checkpoint(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text("".join(f'{{"step": {step}}}\n' for step in range(1, 6)) + '{"step": 6, "lo')
    journal = Journal(path, steps_done=3)
    journal.write({"step": 4})
    journal.close()
    assert steps_in(path) == [1, 2, 3, 4]
    Journal(path, steps_done=0).close()
    assert steps_in(path) == []


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
    pytest.importorskip("tensorboardX", reason="the extra tensorboard is not installed")
    write(tmp_path, {1: 0.5, 2: 0.25, 3: 0.125}, steps_done=0)
    write(tmp_path, {2: 0.75, 3: 0.625}, steps_done=1)
    assert shown(tmp_path, "loss") == [(1, 0.5), (2, 0.75), (3, 0.625)]


HEADER = CheckpointHeader(
    step=7, elapsed_s=1.5, dataset_sha256="ab" * 32, config=TrainingConfig(steps=9, max_gaussians=40)
)


def test_round_trip(tmp_path):
    tensors = {"a": torch.randn(3, 2), "b": torch.arange(4)}
    write_checkpoint(tmp_path / "c", HEADER, tensors)
    header, found = read_checkpoint(tmp_path / "c")
    assert header == HEADER == read_checkpoint_header(tmp_path / "c")
    assert all(torch.equal(found[name], tensor) for name, tensor in tensors.items())
    assert [path.name for path in tmp_path.iterdir()] == ["c"]


def test_refuses_what_is_no_checkpoint(tmp_path):
    path = tmp_path / "c"
    with pytest.raises(TrainingStateInvalid, match="no such file: there is nothing to resume"):
        read_checkpoint(path)
    save_file({"a": torch.ones(1)}, path)
    with pytest.raises(TrainingStateInvalid, match="c: not a checkpoint of a training"):
        read_checkpoint(path)
    save_file({"a": torch.ones(1)}, path, metadata={METADATA_KEY: '{"format_version": 99}'})
    with pytest.raises(TrainingStateInvalid, match=r"its format_version is 99, .* a newer release wrote it"):
        read_checkpoint(path)
    write_checkpoint(path, HEADER, {"a": torch.ones(100)})
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(TrainingStateInvalid, match="not a checkpoint that can be read"):
        read_checkpoint(path)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"step": 10}, "its step is 10, expected 1 to 9"),
        ({"step": True}, "its step is True, expected 1 to 9"),
        ({"elapsed_s": math.nan}, "its elapsed_s is nan, expected seconds"),
        ({"config": {"steps": 9, "max_gaussians": 40, "colour": 1}}, "a training has no setting colour"),
        ({"config": 3}, "int"),
        ({"config": {"steps": 9}}, "its max_gaussians is null, expected a number"),
    ],
)
def test_refuses_a_header_that_no_run_wrote(tmp_path, changes, reason):
    document = {"format_version": FORMAT_VERSION, **asdict(HEADER), **changes}
    save_file({"a": torch.ones(1)}, tmp_path / "c", metadata={METADATA_KEY: json.dumps(document)})
    with pytest.raises(TrainingStateInvalid, match=f"c: not a checkpoint that can be read: .*{reason}"):
        read_checkpoint_header(tmp_path / "c")


@pytest.mark.parametrize("text", ["3", "null", '["format_version"]', "{"])
def test_refuses_metadata_that_is_no_object(tmp_path, text):
    save_file({"a": torch.ones(1)}, tmp_path / "c", metadata={METADATA_KEY: text})
    with pytest.raises(TrainingStateInvalid, match="c: not a checkpoint that can be read"):
        read_checkpoint_header(tmp_path / "c")


def test_refuses_another_run():
    path = Path("c")
    check_same_run(path, HEADER, replace(HEADER.config, memory_gb=3.0), HEADER.dataset_sha256)
    with pytest.raises(TrainingStateInvalid, match="it belongs to another dataset"):
        check_same_run(path, HEADER, HEADER.config, "cd" * 32)
    with pytest.raises(TrainingStateInvalid, match="other settings: steps is 9 there, 10 here"):
        check_same_run(path, HEADER, replace(HEADER.config, steps=10), HEADER.dataset_sha256)

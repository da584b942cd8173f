"""What a run tells while it goes: progress, the journal of its steps, TensorBoard, and pictures of a held-out frame."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ultragray.errors import InvalidArgument
from ultragray.files import write_whole
from ultragray.installation import install_advice

SMOOTHING = 0.05  # weight of the newest step in the mean time of a step


@dataclass(frozen=True)
class Progress:
    """After a step. `val_psnr_db` is the latest over some held-out frames; None before the first, or without any.

    `beside` names a training on a part of the frames: before the run, to choose its effort, and after it, to fit the
    scene's confidence; None in the run. `seconds_left` of the run holds the fit too, about; else it is of the part.
    `peak_memory_mb` (10^6 bytes) is the most that the run took of a GPU until it was last looked at; None on the CPU.
    """

    step: int  # steps done
    steps: int
    loss: float
    gaussian_count: int
    steps_per_s: float
    seconds_left: float
    val_psnr_db: float | None
    val_step: int | None  # after which it was measured
    peak_memory_mb: float | None = None
    beside: str | None = None


@dataclass(frozen=True)
class Course:
    """The way of a training that has ended."""

    seconds: float  # of all steps
    losses: list[float]  # of each step
    val_psnr_db: dict[int, float]  # by step, over some held-out frames

    @classmethod
    def of_journal(cls, journal: Path) -> Course:
        """As the `metrics.jsonl` of a run tells it. Raises OSError."""
        lines = [json.loads(line) for line in journal.read_text(encoding="utf-8").splitlines()]
        return cls(
            seconds=float(lines[-1]["elapsed_s"]),
            losses=[line["loss"] for line in lines],
            val_psnr_db={line["step"]: line["val_psnr_db"] for line in lines if "val_psnr_db" in line},
        )

    @property
    def step_s(self) -> float:
        return self.seconds / len(self.losses)


class StepTimer:
    """The time that steps take, smoothed."""

    def __init__(self, elapsed_s: float = 0.0) -> None:
        self.elapsed_s = elapsed_s  # of all steps, those before a resume too
        self._step_s: float | None = None

    def add(self, seconds: float) -> None:
        self.elapsed_s += seconds
        self._step_s = seconds if self._step_s is None else self._step_s + SMOOTHING * (seconds - self._step_s)

    def rate(self) -> float:
        """Steps a second; 0 before the first."""
        return 1.0 / self._step_s if self._step_s else 0.0


class Journal:
    """Appends to a JSONL file; a line is in the file when `write` returns."""

    def __init__(self, path: Path, *, steps_done: int) -> None:
        """Begins the file anew, or goes on after the lines of the first `steps_done` steps; damage cuts it short."""
        write_whole(path, b"".join(_lines_until(path, steps_done)))
        self._file = path.open("a", encoding="utf-8")

    def write(self, line: Mapping[str, float]) -> None:
        self._file.write(json.dumps(dict(line), allow_nan=False) + "\n")
        self._file.flush()

    def close(self) -> None:
        self._file.close()


def _lines_until(path: Path, steps_done: int) -> list[bytes]:
    """The lines of steps up to `steps_done`, before the first bad one: a killed run may have written half a line."""
    if not steps_done or not path.exists():
        return []
    kept = []
    for line in path.read_bytes().splitlines(keepends=True):
        try:
            document = json.loads(line)
        except (ValueError, RecursionError):
            break
        step = document.get("step") if isinstance(document, dict) else None
        if not line.endswith(b"\n") or type(step) is not int or not 1 <= step <= steps_done:
            break
        kept.append(line)
    return kept


def require_tensorboard() -> None:
    """Raises InvalidArgument where tensorboardX, which writes what TensorBoard reads, is not installed."""
    try:
        import tensorboardX  # noqa: F401
    except ImportError as error:
        raise InvalidArgument(
            f"tensorboardX is not installed: {install_advice('tensorboard')}", field="tensorboard"
        ) from error


class Board:
    """Writes the numbers of each step beside the journal."""

    def __init__(self, folder: Path, *, steps_done: int) -> None:
        """Raises InvalidArgument where tensorboardX is not installed. Later steps of an earlier run are hidden."""
        require_tensorboard()
        from tensorboardX import SummaryWriter

        purge = steps_done + 1 if steps_done else None
        suffix = f".{steps_done:08d}"  # names have the time in seconds only, and are read in their order
        self._writer = SummaryWriter(str(folder), purge_step=purge, filename_suffix=suffix)

    def write(self, line: Mapping[str, float]) -> None:
        for name, value in line.items():
            if name != "step":
                self._writer.add_scalar(name, value, int(line["step"]))

    def close(self) -> None:
        self._writer.close()

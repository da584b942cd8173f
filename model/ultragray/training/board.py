"""Metrics as TensorBoard event files, where the extra `tensorboard` is installed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ultragray.errors import InvalidArgument
from ultragray.installation import install_advice


def require_tensorboard() -> None:
    """Raises InvalidArgument where TensorBoard is not installed."""
    try:
        import torch.utils.tensorboard  # noqa: F401
    except ImportError as error:
        raise InvalidArgument(
            f"TensorBoard is not installed: {install_advice('tensorboard')}", field="tensorboard"
        ) from error


class Board:
    """Writes the numbers of each step beside the journal."""

    def __init__(self, folder: Path, *, steps_done: int) -> None:
        """Raises InvalidArgument where TensorBoard is not installed. Later steps of an earlier run are hidden."""
        require_tensorboard()
        from torch.utils.tensorboard import SummaryWriter

        self._writer = SummaryWriter(str(folder), purge_step=steps_done + 1 if steps_done else None)

    def write(self, line: Mapping[str, float]) -> None:
        """A line of the journal, by its step."""
        for name, value in line.items():
            if name != "step":
                self._writer.add_scalar(name, value, int(line["step"]))

    def close(self) -> None:
        self._writer.close()

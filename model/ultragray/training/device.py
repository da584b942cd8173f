"""The device that a training runs on: which one is meant, and how much of its memory was taken."""

from __future__ import annotations

import torch

from ultragray.backends import cuda
from ultragray.errors import BackendUnavailable


def training_device(name: str, backend: str) -> torch.device:
    """The device of a training's tensors: `cpu`, `cuda` (the first GPU) or `cuda:N`.

    Raises BackendUnavailable for any other name, for a device that is not there, and for one that the backend does not
    render on, saying what to give instead.
    """
    kind, _, number = name.partition(":")
    if name != "cpu" and not (kind == "cuda" and (name == "cuda" or (number.isascii() and number.isdecimal()))):
        raise BackendUnavailable(f"device must be cpu, cuda or cuda:N, got {name!r}", field="device")
    if kind == "cpu" and backend == "cuda":
        cuda.require()
        if not cuda.interpreted():
            raise BackendUnavailable(
                "backend cuda renders on a GPU, but the device is cpu: give device cuda as well, or another backend",
                field="device",
            )
    device = torch.device("cpu") if kind == "cpu" else cuda.device(int(number or 0))
    if device.type == "cuda" and backend == "cpu":
        raise BackendUnavailable(
            f"backend cpu renders on the CPU, but the device is {name}: give device cpu as well, or backend cuda",
            field="backend",
        )
    return device


def forget_peak_memory(device: torch.device) -> None:
    """Start the count of `peak_memory_mb` anew."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def peak_memory_mb(device: torch.device) -> float | None:
    """The most that tensors took of a GPU's memory at a time, MB (10^6 bytes); None on the CPU."""
    return torch.cuda.max_memory_allocated(device) / 1e6 if device.type == "cuda" else None

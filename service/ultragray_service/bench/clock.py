"""Time as a device counts it: by its own events, or by the host's clock where the CPU is the device."""

from __future__ import annotations

import time

import torch

Mark = float | torch.cuda.Event  # seconds of the host's clock, or a place in the device's queue


def mark(device: torch.device) -> Mark:
    """Now, or on a GPU when all that was queued before is done."""
    if device.type == "cpu":
        return time.perf_counter()
    event = torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]
    event.record()
    return event


def elapsed_ms(first: Mark, last: Mark) -> float:
    """Between two marks of one device, which has done what was queued before the last."""
    if isinstance(first, float) or isinstance(last, float):
        assert isinstance(first, float)
        assert isinstance(last, float)
        return 1000.0 * (last - first)
    return float(first.elapsed_time(last))


def finish(device: torch.device) -> None:
    """Waits until the device has done what was queued."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)

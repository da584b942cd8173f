"""The device that a backend's scenes must be on."""

from __future__ import annotations

import torch

from ultragray.backends import cuda


def render_device(backend: str, number: int = 0) -> torch.device:
    """GPU `number`, counted round and round, for `cuda` and where there is one for `auto`; else the CPU.

    Raises BackendUnavailable for `cuda` where there is none.
    """
    if backend == "cuda" or (backend == "auto" and cuda.available()):
        return cuda.device(number % max(1, cuda.device_count()))
    return torch.device("cpu")

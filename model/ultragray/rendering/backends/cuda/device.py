"""The device of the CUDA backend, and the error where there is none. Needs neither Triton nor a context."""

from __future__ import annotations

import importlib.util
import os

import torch
from torch import Tensor

from ultragray.errors import BackendUnavailable
from ultragray.scene.gaussians import GaussianScene


def interpreted() -> bool:
    """Whether Triton's interpreter runs the kernels, on the CPU (TRITON_INTERPRET=1): for tests without a GPU."""
    return os.environ.get("TRITON_INTERPRET") == "1" and importlib.util.find_spec("triton") is not None


def available() -> bool:
    """Whether the backend can render here."""
    return _missing() is None


def require() -> None:
    """Raises BackendUnavailable, saying what is missing, where the backend cannot render here."""
    if (missing := _missing()) is not None:
        raise BackendUnavailable(f"{missing}; the CPU does the same (backend cpu, device cpu)", field="backend")


def _missing() -> str | None:
    if interpreted():
        return None
    if not torch.cuda.is_available():
        built = torch.version.cuda
        why = "no CUDA device was found" if built else f"torch {torch.__version__} was built without CUDA"
        return f"backend cuda needs an NVIDIA GPU and torch's CUDA build, but {why}"
    if importlib.util.find_spec("triton") is None:
        return "backend cuda needs the package triton, which torch's CUDA build brings along, but it is not installed"
    return None


def device_count() -> int:
    """Visible CUDA devices; 1 where the kernels are interpreted."""
    return 1 if interpreted() else torch.cuda.device_count()


def device(index: int = 0) -> torch.device:
    """The device of a scene's tensors: the CUDA device of that number, or the CPU where the kernels are interpreted.

    Raises BackendUnavailable.
    """
    require()
    if interpreted():
        return torch.device("cpu")
    if not 0 <= index < device_count():
        raise BackendUnavailable(
            f"CUDA device {index} was asked for, but there are {device_count()}, numbered from 0", field="device"
        )
    return torch.device("cuda", index)


def supports(scene: GaussianScene) -> bool:
    """Whether the backend can render the scene: float32 on a CUDA device, or on the CPU where it is interpreted, its
    tissue at rest."""
    wanted = "cpu" if interpreted() else "cuda"
    return (
        not scene.displacements
        and scene.means.device.type == wanted
        and scene.means.dtype == torch.float32
        and available()
    )


def upload(tensor: Tensor, device: torch.device) -> Tensor:
    """A tensor of the CPU on the device, without waiting for what the device still has to do."""
    if device.type != "cuda":
        return tensor
    return tensor.contiguous().pin_memory().to(device, non_blocking=True)  # an expanded tensor has no memory to copy to


def renderer(device: torch.device) -> str:
    """The name of the renderer on a device, as frames carry it: `cuda-sm90`."""
    if interpreted():
        return "cuda-interpreted"
    major, minor = torch.cuda.get_device_capability(device)
    return f"cuda-sm{major}{minor}"

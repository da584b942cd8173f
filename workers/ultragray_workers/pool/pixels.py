"""Rendered frames on their way out of a worker process: copied from the GPU while the next ones are rendered, and
encoded.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cache
from typing import Any, BinaryIO, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ultragray.geometry.probe import FloatArray
from ultragray.rendering.outputs import OUTPUTS
from ultragray.rendering.pixels import PixelArray
from ultragray.scene.confidence import Extrapolation, figure_arrays

CHUNK_POSES = 8  # rendered in one launch; while they are copied and written, the next ones are rendered

Pixels = npt.NDArray[Any]  # floats, or uint8: labels, and what the GPU has rounded
Wanted = Mapping[str, Collection[np.dtype[Any]]]  # the pixel types that an output is asked for in

_TORCH_TYPES = {np.dtype("u1"): torch.uint8, np.dtype("<f4"): torch.float32, np.dtype("<f2"): torch.float16}


class Arriving(Protocol):
    """Frames of a batch, which may be on their way still."""

    waited_ms: float  # in `take`, so far

    def take(self, name: str, pixel_type: np.dtype[Any], first: int, stop: int) -> Pixels:  # [stop - first, H, W]
        """Waits for an output of the poses `first` to `stop`: in that pixel type, or as rendered for the encoder to
        turn into it.

        Raises RuntimeError where the GPU failed.
        """


def render_to_host(
    render: Callable[[FloatArray], Mapping[str, Tensor]],  # poses [C, 4, 4] -> each output [C, H, W]
    poses: FloatArray,  # [C, 4, 4] mm
    wanted: Wanted,
    device: torch.device,
) -> Arriving:
    """Renders a batch. On a GPU it returns once all is launched.

    Raises what `render` raises, and torch.OutOfMemoryError.
    """
    return _FromGpu(render, poses, wanted, device) if device.type == "cuda" else _OnHost(render(poses), wanted)


def round_to_uint8(frames: Tensor) -> Tensor:
    """`ultragray.rendering.pixels.to_uint8` of a tensor, on the device where that is."""
    return frames if frames.dtype == torch.uint8 else frames.clamp(max=1.0).mul_(255.0).round_().to(torch.uint8)


class _OnHost:
    """There is nothing to copy, and the encoder rounds faster than torch."""

    waited_ms = 0.0

    def __init__(self, frames: Mapping[str, Tensor], wanted: Wanted) -> None:
        self._frames = {
            name: (frames[name] if frames[name].dtype == torch.uint8 else frames[name].float()).numpy()
            for name in wanted
        }

    def take(self, name: str, pixel_type: np.dtype[Any], first: int, stop: int) -> Pixels:
        frames = self._frames[name][first:stop]
        if pixel_type == np.uint8:
            return OUTPUTS[name].shares(frames)
        if pixel_type == np.float16:  # which numpy would take 40 times as long for
            return torch.from_numpy(frames).half().numpy()
        return frames


class _FromGpu:
    def __init__(
        self,
        render: Callable[[FloatArray], Mapping[str, Tensor]],
        poses: FloatArray,  # [C, 4, 4]
        wanted: Wanted,
        device: torch.device,
    ) -> None:
        self.waited_ms = 0.0
        self._host: dict[tuple[str, np.dtype[Any]], Tensor] = {}  # each [C, H, W], pinned
        self._copied: list[torch.cuda.Event] = []  # one a chunk
        rendering = torch.cuda.current_stream(device)
        copying = _copy_stream(device)
        for first in range(0, len(poses), CHUNK_POSES):
            frames = render(poses[first : first + CHUNK_POSES])
            ready = {
                (name, pixel_type): round_to_uint8(OUTPUTS[name].shares(frames[name]))
                if pixel_type == np.uint8
                else frames[name].to(_TORCH_TYPES[pixel_type])
                for name, pixel_types in wanted.items()
                for pixel_type in pixel_types
            }
            copying.wait_stream(rendering)
            with torch.cuda.stream(copying):
                for key, pixels in ready.items():
                    self._buffer(key, len(poses), pixels)[first : first + len(pixels)].copy_(pixels, non_blocking=True)
                    pixels.record_stream(copying)  # its memory must not be given to a later chunk before it is copied
                self._copied.append(copying.record_event())

    def _buffer(self, key: tuple[str, np.dtype[Any]], poses: int, pixels: Tensor) -> Tensor:  # -> [C, H, W]
        """Pinned memory, without which a copy is not asynchronous. torch keeps it for the next batch."""
        if key not in self._host:
            self._host[key] = torch.empty((poses, *pixels.shape[1:]), dtype=_TORCH_TYPES[key[1]], pin_memory=True)
        return self._host[key]

    def take(self, name: str, pixel_type: np.dtype[Any], first: int, stop: int) -> Pixels:
        started = time.monotonic()
        self._copied[(stop - 1) // CHUNK_POSES].synchronize()  # one stream copies them in turn
        self.waited_ms += (time.monotonic() - started) * 1000.0
        return self._host[name, pixel_type][first:stop].numpy()


@cache
def _copy_stream(device: torch.device) -> torch.cuda.Stream:
    return torch.cuda.Stream(device)  # type: ignore[no-untyped-call]


def write_npz(
    file: BinaryIO,
    frames: Mapping[str, PixelArray],  # each [C, H, W]
    poses: FloatArray,  # [C, 4, 4] mm
    extrapolations: Sequence[Extrapolation],  # [C]
    *,
    scene: str,
    scene_sha256: str,
    renderer: str,
) -> int:
    """Writes an .npz archive, labels as uint8, at the start of `file`; its size in bytes."""
    file.seek(0)
    arrays: dict[str, Any] = {
        **{name: np.asarray(pixels, OUTPUTS[name].dtype) for name, pixels in frames.items()},
        "poses": np.asarray(poses, dtype=np.float64),
        **figure_arrays(extrapolations),
        "scene": np.array(scene),
        "scene_sha256": np.array(scene_sha256),
        "renderer": np.array(renderer),
    }
    np.savez(file, **arrays)
    return file.tell()

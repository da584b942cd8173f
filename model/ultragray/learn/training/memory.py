"""The device that a training runs on, and the memory that it will need there at its largest, known before it starts."""

from __future__ import annotations

import math
import os
from contextlib import suppress
from pathlib import Path

import torch

from ultragray.errors import BackendUnavailable, MemoryExceeded
from ultragray.installation import processor_name
from ultragray.learn.evaluation.scoring import CHUNK_PIXELS, frames_at_once
from ultragray.learn.sweep import Dataset
from ultragray.learn.training import alignment as overlap
from ultragray.learn.training.config import TrainingConfig
from ultragray.learn.training.geometry import LOOKED_AT_FRAMES, PREDICTED_PIXELS
from ultragray.rendering.backends import cuda
from ultragray.scene.info import expected_shapes


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


def machine_in_words(device: str = "cpu") -> str:
    threads = torch.get_num_threads()
    words = f"{processor_name()}, {threads} thread{'' if threads == 1 else 's'}"
    on = training_device(device, "auto")
    return words if on.type == "cpu" else f"{words}, {torch.cuda.get_device_name(on)}"


def forget_peak_memory(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.init()  # type: ignore[no-untyped-call]  # there is nothing to reset before
        torch.cuda.reset_peak_memory_stats(device)


def peak_memory_mb(device: torch.device) -> float | None:
    """The most that tensors took of a GPU's memory at a time, MB (10^6 bytes); None on the CPU."""
    return torch.cuda.max_memory_allocated(device) / 1e6 if device.type == "cuda" else None


# The memory that a training will need at its largest, known before it starts.
#
# The machine's for the backend `cpu`, the GPU's where that trains; `reference` keeps a graph of [H, W] for every
# Gaussian that a frame touches, which nobody can foresee.

BASE_BYTES = 512 << 20  # the process with torch loaded, and the scratch memory of its kernels (measured: up to 500)
COPIES = 16  # parameters, gradients, moments; what refinements, checkpoints and the kernel copy (measured: 14)
STATISTICS = 2
PIXEL_FLOATS = 25  # of a pixel of a batch: the outputs and what the backward pass keeps of them (measured: 17)
PADDING = 32  # pixels that the kernel adds to a row
LIST_GAUSSIANS = 4096  # a step lists those that an image plane touches, so many in a list
LIST_BYTES = 72 * 4160  # of a full list: it begins with room for 1040 slices of 72 bytes and doubles twice
MEASURED_BYTES = 288  # of a pixel of the held-out frames that are measured at once (measured: 234 to 259)
COMPARED_BYTES = 8 * 2 * PREDICTED_PIXELS + 32_768  # of a frame beside its distances, when frames are compared
REGISTERED_BYTES = 4  # of a pixel of the frames that sweeps are registered by: a copy, and its detail of 2 bytes
SHADOW_BYTES = 4 * 5  # of a pixel of the frames that shadows are looked for in: copies as they are compared
CUDA_BASE_BYTES = 256 << 20  # what torch's allocator rounds up and leaves unused
CUDA_SLICE_BYTES = 4 * (20 + 1 + 9)  # of a Gaussian in a pose: the slice, its place and its gradient
CUDA_PLANES = 10  # of a pose, as large as a frame: the frame, what it is made of, and their gradients
CUDA_LOSS_FLOATS = 72  # of a pixel of a batch: the fields of SSIM, what autograd keeps of them (measured on a CPU: 68)
GIB = 1 << 30
CONTROL_GROUPS = Path("/sys/fs/cgroup")


def required_bytes(dataset: Dataset, config: TrainingConfig) -> int:
    """An upper bound of the process's memory, dataset included."""
    assert config.max_gaussians is not None
    frames = config.batch_size  # views between them are drawn however few there are
    height, width = dataset.train.height, dataset.train.width
    stepping = 4 * PIXEL_FLOATS * frames * height * (width + PADDING)
    measured = max(len(dataset.val), len(dataset.train) if config.confidence else 0)
    measuring = MEASURED_BYTES * min(measured * height * width, max(CHUNK_PIXELS, height * width))
    shadows = SHADOW_BYTES * min(len(dataset.train), LOOKED_AT_FRAMES) * height * width
    beginning = max(comparison_bytes(dataset, config), shadows)
    slices = frames * -(-config.max_gaussians // LIST_GAUSSIANS) * LIST_BYTES  # as if all touched all planes
    copies = 3 if config.confidence else 2  # the dataset's, the trainer's and that of the frames it calibrates with
    copies += bool(config.transmittance and config.absorption_penalty)  # a byte says whether a pixel is in a shadow
    images = copies * dataset.train.images.nbytes + dataset.val.images.nbytes
    return BASE_BYTES + _gaussian_bytes(config) + slices + max(stepping, measuring, beginning) + images


def required_device_bytes(dataset: Dataset, config: TrainingConfig) -> int:
    assert config.max_gaussians is not None
    height, width = dataset.train.height, dataset.train.width
    per_frame = config.max_gaussians * CUDA_SLICE_BYTES + 4 * CUDA_PLANES * height * width
    stepping = config.batch_size * (per_frame + 4 * CUDA_LOSS_FLOATS * height * width)
    measuring = min(len(dataset.val), frames_at_once(height, width)) * per_frame
    images = 2 * dataset.train.images.nbytes  # they, and which of their pixels lie in a shadow
    return CUDA_BASE_BYTES + _gaussian_bytes(config) + max(stepping, measuring) + images


def _gaussian_bytes(config: TrainingConfig) -> int:
    assert config.max_gaussians is not None
    floats = sum(math.prod(shape) for shape in expected_shapes(1, config.sh_degree).values())
    return 4 * config.max_gaussians * (floats * COPIES + STATISTICS)


def comparison_bytes(dataset: Dataset, config: TrainingConfig) -> int:
    """An upper bound of what Geometry.of and the registration of sweeps take to compare the training frames."""
    count, registered = len(dataset.train), 0
    if config.refine_poses not in ("none", "path"):
        registered = min(count, 2 * overlap.FRAMES) * dataset.train.height * dataset.train.width
    return max(8 * count**2 + COMPARED_BYTES * count, REGISTERED_BYTES * registered)


def available_bytes() -> int | None:
    """Memory that is left for this process: what is free, less where its control group allows less; None: unknown."""
    limits = [value for value in (_free_memory(), _left_in_group()) if value is not None]
    return min(limits) if limits else None


def _free_memory() -> int | None:
    with suppress(OSError):
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    with suppress(ValueError, OSError):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return None


def _left_in_group() -> int | None:
    for folder, limit, used, reclaimable in (
        (CONTROL_GROUPS, "memory.max", "memory.current", "inactive_file"),
        (CONTROL_GROUPS / "memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    ):
        with suppress(OSError, ValueError):  # another layout, or "max": no limit
            lines = (folder / "memory.stat").read_text(encoding="ascii").splitlines()
            cached = int(dict(line.split() for line in lines).get(reclaimable, 0))  # counts as used but can be had
            return int((folder / limit).read_text()) - int((folder / used).read_text()) + cached
    return None


def check_memory(dataset: Dataset, config: TrainingConfig, device: torch.device) -> None:
    """Raises MemoryExceeded, saying what to lower, where the training may need more of a device than it can have."""
    if device.type == "cuda":
        needed = required_device_bytes(dataset, config)
        missing = _missing(needed, config, torch.cuda.mem_get_info(device)[0], str(device))
    else:
        needed = required_bytes(dataset, config)
        missing = _missing(needed, config, available_bytes())
    if missing:
        raise MemoryExceeded(
            f"the training needs up to {needed / GIB:.1f} GiB with {config.max_gaussians or 0:,} Gaussians and batches "
            f"of {config.batch_size} frames of {dataset.train.height}x{dataset.train.width}, {missing}: lower "
            "max_gaussians or batch_size",
            field="max_gaussians",
        )


def check_comparison_memory(dataset: Dataset, config: TrainingConfig) -> None:
    """Raises MemoryExceeded where comparing the frames, before anything else, may need more than it can have."""
    needed = comparison_bytes(dataset, config)
    if missing := _missing(needed, config, available_bytes()):
        raise MemoryExceeded(
            f"{dataset.train.source}: comparing its {len(dataset.train):,} frames needs up to {needed / GIB:.1f} GiB, "
            f"{missing}: train from fewer frames",
            field="train_frames",
        )


def _missing(needed: int, config: TrainingConfig, free: int | None, place: str = "this machine") -> str | None:
    """The lowest of the limits, where less than is needed, and who sets it: a setting allows no more than there is."""
    limits = [] if free is None else [(free, f"{place} has free")]
    if config.memory_gb is not None:
        limits.append((int(config.memory_gb * GIB), "memory_gb allows"))
    limit, bound = min(limits, default=(needed, ""))
    return f"{bound} {limit / GIB:.1f} GiB" if needed > limit else None

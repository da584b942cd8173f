"""The memory that a training will need at its largest, known before it starts."""

from __future__ import annotations

import os
from pathlib import Path

from ..datasets.sweep import Dataset
from ..errors import MemoryExceeded
from .config import TrainingConfig

BASE_BYTES = 400 << 20  # the process with torch loaded, and the scratch memory of its kernels
RAW_FLOATS = 3 + 3 + 4 + 1 + 1  # of a Gaussian, without the harmonics above degree 0
COPIES = 16  # parameters, gradients, moments; what refinements, checkpoints and the kernel copy (measured: 14)
STATISTICS = 2
PIXEL_FLOATS = 32  # of a pixel of a batch: the outputs and what the backward pass keeps of them (measured: 17)
GIB = 1 << 30


def required_bytes(dataset: Dataset, config: TrainingConfig) -> int:
    """An upper bound of the process's memory, dataset included."""
    assert config.max_gaussians is not None
    harmonics = (config.sh_degree + 1) ** 2 - 1
    gaussians = 4 * config.max_gaussians * ((RAW_FLOATS + harmonics) * COPIES + STATISTICS)
    frames = min(config.batch_size, len(dataset.train))
    pixels = dataset.train.height * dataset.train.width
    images = 2 * (dataset.train.images.nbytes + dataset.val.images.nbytes)  # the dataset's and the trainer's copy
    return BASE_BYTES + gaussians + 4 * PIXEL_FLOATS * frames * pixels + images


def available_bytes() -> int | None:
    """What this process may still take: free memory, less where its control group allows less; None: unknown."""
    found = [value for value in (_free_memory(), _left_in_group()) if value is not None]
    return min(found) if found else None


def _free_memory() -> int | None:
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError):
        return None


def _left_in_group() -> int | None:
    folder = Path("/sys/fs/cgroup")
    for limit, used in (
        ("memory.max", "memory.current"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes"),
    ):
        try:
            return int((folder / limit).read_text()) - int((folder / used).read_text())
        except (OSError, ValueError):  # another layout, or "max": no limit
            continue
    return None


def check_memory(dataset: Dataset, config: TrainingConfig) -> None:
    """Raises MemoryExceeded, saying what to lower, where the training may need more than it can have."""
    needed = required_bytes(dataset, config)
    limit = available_bytes() if config.memory_gb is None else int(config.memory_gb * GIB)
    if limit is not None and needed > limit:
        source = "this machine has free" if config.memory_gb is None else "memory_gb allows"
        raise MemoryExceeded(
            f"the training needs up to {needed / GIB:.1f} GiB with {config.max_gaussians or 0:,} Gaussians and batches "
            f"of {config.batch_size} frames of {dataset.train.height}x{dataset.train.width}, {source} "
            f"{limit / GIB:.1f} GiB: lower max_gaussians or batch_size",
            field="max_gaussians",
        )

"""A GPU as a machine, and its limits, measured in the same run: bytes copied, fp32 multiply-adds."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
import triton
import triton.language as tl

from ultragray.rendering.backends import cuda
from ultragray_service.bench.kernel import elapsed_ms, finish, mark
from ultragray_service.bench.measured import measured
from ultragray_service.bench.report import versions

COPY_BYTES = 2 << 30  # far more than any cache holds
REPEATS = 10
LANES = 1024  # values of a program
CHAINS = 4  # multiply-adds of a value that do not wait for each other
PROGRAMS, ROUNDS = 16_384, 2_048


@dataclass(frozen=True)
class Limits:
    """The best of a few repetitions. A multiply-add is two operations; a copied byte is read and written."""

    bytes_per_s: float
    operations_per_s: float


def measure_limits(device: torch.device) -> Limits:
    """By a copy within the device's memory, and by a kernel of nothing but fp32 multiply-adds in registers."""
    copy_bytes, programs, rounds = (1 << 20, 2, 4) if cuda.interpreted() else (COPY_BYTES, PROGRAMS, ROUNDS)
    source = torch.zeros(copy_bytes, dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    values = torch.empty(programs * LANES, device=device)
    copy_ms = _best_ms(device, lambda: target.copy_(source))
    multiply_ms = _best_ms(device, lambda: multiply_add[(programs,)](values, 0.5, 0.25, rounds, LANES=LANES))
    return Limits(
        bytes_per_s=2 * copy_bytes / (copy_ms / 1000.0),
        operations_per_s=2 * CHAINS * rounds * programs * LANES / (multiply_ms / 1000.0),
    )


def _best_ms(device: torch.device, work: Callable[[], object]) -> float:
    marks = [mark(device)]
    for _ in range(REPEATS):
        work()
        marks.append(mark(device))
    finish(device)
    return min(elapsed_ms(*pair) for pair in pairwise(marks[1:]))  # the first compiles


@triton.jit  # type: ignore[untyped-decorator]
def multiply_add(out: Any, factor: Any, term: Any, rounds: Any, LANES: tl.constexpr) -> None:  # noqa: N803
    """out[i]: the sum of four chains of x ← x·factor + term, `rounds` long, which begin at 0, 1, 2 and 3 + i·1e-6."""
    places = tl.program_id(0) * LANES + tl.arange(0, LANES)
    a = places * 1e-6
    b, c, d = a + 1.0, a + 2.0, a + 3.0
    for _ in range(rounds):
        a = a * factor + term
        b = b * factor + term
        c = c * factor + term
        d = d * factor + term
    tl.store(out + places, a + b + c + d)


def gpu_document(device: torch.device, **figures: Any) -> dict[str, Any]:
    """A document that begins with commit, date, machine, versions and the GPU with its driver."""
    gpu: dict[str, Any] = {"renderer": cuda.renderer(device)}
    if device.type == "cuda":
        properties = torch.cuda.get_device_properties(device)
        gpu |= {
            "name": properties.name,
            "memory_mb": properties.total_memory / 1e6,
            "multiprocessors": properties.multi_processor_count,
            "driver": _driver_version(),
        }
    gpu |= {"cuda": torch.version.cuda, "triton": triton.__version__}
    return {"measured": measured(torch.get_num_threads()), "versions": versions(), "gpu": gpu, **figures}


def _driver_version() -> str | None:
    """The version of the NVIDIA driver, where its own tool is there to tell."""
    if (tool := shutil.which("nvidia-smi")) is None:
        return None
    command = [tool, "--query-gpu=driver_version", "--format=csv,noheader"]
    versions_of_gpus = subprocess.run(command, capture_output=True, text=True, check=False).stdout.split()
    return versions_of_gpus[0] if versions_of_gpus else None

"""The benchmarks by name and backend: each is a function of a module that is imported when it is chosen."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path

from ultragray.errors import BackendUnavailable, InvalidArgument

Bench = Callable[[Path | None, bool], None]  # the JSON file to write, and whether few repetitions do

_BENCHES = {
    ("frames", "cpu"): ("served", "bench_frames"),
    ("frames", "cuda"): ("cuda", "bench_frames"),
    ("train", "cpu"): ("parts", "bench_training"),
    ("train", "cuda"): ("cuda", "bench_training"),
    ("jobs", "cpu"): ("clients", "bench_jobs"),
    ("clients", "cpu"): ("clients", "bench_clients"),
    ("kernel-details", "cpu"): ("parts", "bench_kernel_details"),
}
BACKENDS = tuple(dict.fromkeys(backend for _, backend in _BENCHES))


def chosen_bench(name: str, backend: str) -> Bench:
    """The benchmark of that name on a backend.

    Raises BackendUnavailable for one that is not cpu or cuda, and for cuda where there is no GPU; InvalidArgument for
    a benchmark that the backend does not have.
    """
    if backend not in BACKENDS:
        raise BackendUnavailable(f"backend must be {' or '.join(BACKENDS)}, got {backend!r}", field="backend")
    if (place := _BENCHES.get((name, backend))) is None:
        raise InvalidArgument(f"--{name} goes without --backend", field="backend")
    if backend == "cuda":
        from ultragray.rendering.backends import cuda

        cuda.require()
    module, function = place
    bench: Bench = getattr(importlib.import_module(f".{module}", __package__), function)
    return bench

"""The benchmarks by name and backend: each is the `run` of a module, imported when it is chosen."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path

from ultragray.errors import BackendUnavailable, InvalidArgument

Bench = Callable[[Path | None, bool], None]  # the JSON file to write, and whether few repetitions do

_BENCHES = {
    ("frames", "cpu"): "frames",
    ("frames", "cuda"): "cuda.frames",
    ("train", "cpu"): "train",
    ("train", "cuda"): "cuda.train",
    ("jobs", "cpu"): "jobs",
    ("clients", "cpu"): "clients",
    ("kernel-details", "cpu"): "kernel_details",
}
BACKENDS = tuple(dict.fromkeys(backend for _, backend in _BENCHES))


def chosen_bench(name: str, backend: str) -> Bench:
    """The benchmark of that name on a backend.

    Raises BackendUnavailable for one that is not cpu or cuda, and for cuda where there is no GPU; InvalidArgument for
    a benchmark that the backend does not have.
    """
    if backend not in BACKENDS:
        raise BackendUnavailable(f"backend must be {' or '.join(BACKENDS)}, got {backend!r}", field="backend")
    if (module := _BENCHES.get((name, backend))) is None:
        raise InvalidArgument(f"--{name} goes without --backend", field="backend")
    if backend == "cuda":
        from ultragray.rendering.backends import cuda

        cuda.require()
    bench: Bench = importlib.import_module(f".{module}", __package__).run
    return bench

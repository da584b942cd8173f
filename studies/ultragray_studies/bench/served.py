"""`ultragray bench`: the cost of a frame in the kernel and through each front door, here and now.

Each door is that of a real server in a process of its own: gRPC by the Python client, HTTP by the standard library.
Machines drift, so every time is also given in yards, a fixed piece of work timed in the same run (docs/physics.md §5).
"""

from __future__ import annotations

import http.client
import json
import os
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from ultragray.geometry.probe import FloatArray
from ultragray_client import Client, Encoding, FrameStream, RenderSettings
from ultragray_studies.bench.kernel import BenchScene, bench_poses, bench_scenes, measure_kernel, time_ms
from ultragray_studies.bench.report import Report, percentiles
from ultragray_workers.errors import NotReady
from ultragray_workers.jobs.worker.process import account_of
from ultragray_workers.pool.template import WORKER

SCENE = "bench"
IN_FLIGHT = 8
WARM_UP = 20  # first requests of a connection, not counted
START_TIMEOUT_S = 120.0
SETTLED_SHARE = 0.1  # of a core, which a service at rest does not reach


@dataclass(frozen=True)
class FrontDoor:
    """Latencies of one request after another, and the rate where the door allows several in flight."""

    what: str
    latency_ms: list[float]
    frames_per_s: float


@dataclass(frozen=True)
class Served:
    """The figures of a service, and the memory of its worker (resident, shared pages counted by share) in MB."""

    front_doors: list[FrontDoor]
    worker_memory_mb: float


def measure_served(bench: BenchScene, repeats: int, backend: str) -> Served:
    """Measure each front door of a service of the scene. Raises NotReady where it does not come up."""
    poses = bench_poses(repeats + WARM_UP)
    with tempfile.TemporaryDirectory(prefix="ultragray-bench-") as folder:
        bench.scene.save(Path(folder) / f"{SCENE}.ugr")
        with running_server(Path(folder), backend, SCENE) as server:
            doors = [measure(server, poses) for measure in DOORS.values()]
            return Served(doors, max(_memory_of_workers_mb(server.pid), default=0.0))


@dataclass(frozen=True)
class RunningServer:
    """A server of the benchmark."""

    http_port: int
    grpc_port: int
    igtl_port: int
    pid: int
    ready_s: float  # from its start until it was ready

    def client(self) -> Client:
        """A client over gRPC."""
        return Client(f"127.0.0.1:{self.grpc_port}")

    def http(self) -> closing[http.client.HTTPConnection]:
        """A connection over HTTP, which stays open."""
        return closing(http.client.HTTPConnection("127.0.0.1", self.http_port, timeout=START_TIMEOUT_S))


@contextmanager
def running_server(
    folder: Path, backend: str, scene: str, *, job_threads: int = 0, python: str = sys.executable
) -> Iterator[RunningServer]:
    """A service at rest of the scenes in `folder`, `scene` for OpenIGTLink, run by `python`. Raises NotReady."""
    ports = {name: _free_port() for name in ("HTTP", "GRPC", "IGTL")}
    settings = {
        "DATA_FOLDER": folder,
        **{f"{name}_PORT": port for name, port in ports.items()},
        "IGTL_SCENE": scene,
        "TRAINING_THREADS": job_threads,
        "BACKEND": backend,
        "PRELOAD": scene,
        "LOG_LEVEL": "error",
    }
    environment = os.environ | {f"ULTRAGRAY_{name}": str(value) for name, value in settings.items()}
    started = time.perf_counter()
    process = subprocess.Popen([python, "-m", "ultragray_service"], env=environment)
    try:
        server = RunningServer(ports["HTTP"], ports["GRPC"], ports["IGTL"], process.pid, 0.0)
        _wait(partial(_is_ready, server, process), 0.1, "was not ready")
        server = replace(server, ready_s=time.perf_counter() - started)
        # The worker for jobs starts too, which takes some seconds of both cores.
        _wait(partial(_is_settled, process.pid), 0.0, "did not come to rest")
        yield server
    finally:
        process.terminate()
        process.wait(timeout=30)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _wait(is_so: Callable[[], bool], pause_s: float, failing: str) -> None:
    end = time.monotonic() + START_TIMEOUT_S
    while not is_so():
        if time.monotonic() > end:
            raise NotReady(f"the server of the benchmark {failing} within {START_TIMEOUT_S:g} s")
        time.sleep(pause_s)


def _is_ready(server: RunningServer, process: subprocess.Popen[bytes]) -> bool:
    if process.poll() is not None:
        raise NotReady(f"the server of the benchmark ended with the status {process.returncode}")
    with suppress(OSError), server.http() as connection:
        connection.request("GET", "/v1/health/ready")
        return connection.getresponse().status == 200
    return False


def _is_settled(pid: int) -> bool:
    before = account_of(pid).cpu_s
    time.sleep(1.0)
    return account_of(pid).cpu_s - before < SETTLED_SHARE


def _grpc_stream(
    what: str, settings: RenderSettings, shares_memory: bool, server: RunningServer, poses: FloatArray
) -> FrontDoor:
    def ask(stream: FrameStream, pose: FloatArray) -> None:
        stream.send(pose)
        stream.receive()

    with server.client() as client:
        with client.stream(SCENE, settings, shared_memory=shares_memory) as stream:
            latency_ms = [time_ms(ask, stream, pose) for pose in poses]
        with client.stream(SCENE, settings, shared_memory=shares_memory) as stream:
            started = time.perf_counter()
            for pose in poses[:IN_FLIGHT]:
                stream.send(pose)
            for pose in poses[IN_FLIGHT:]:
                stream.receive()
                stream.send(pose)
            for _ in poses[:IN_FLIGHT]:
                stream.receive()
            rate = len(poses) / (time.perf_counter() - started)
    return FrontDoor(what, latency_ms[WARM_UP:], rate)


def _grpc_unary(server: RunningServer, poses: FloatArray) -> FrontDoor:
    with server.client() as client:
        return _one_by_one("gRPC unary", poses, partial(client.render, SCENE))


def _http(what: str, media_type: str, server: RunningServer, poses: FloatArray) -> FrontDoor:
    headers = {"Accept": media_type, "Content-Type": "application/json"}
    with server.http() as connection:

        def render(pose: FloatArray) -> None:
            body = json.dumps({"pose": {"matrix": pose.tolist()}})
            connection.request("POST", f"/v1/scenes/{SCENE}/render", body, headers)
            response = connection.getresponse()
            data = response.read()
            if response.status != 200:
                raise NotReady(f"the benchmark's frame failed: {data[:500]!r}")

        return _one_by_one(what, poses, render)


def _one_by_one(what: str, poses: FloatArray, render: Callable[[FloatArray], object]) -> FrontDoor:
    counted = [time_ms(render, pose) for pose in poses][WARM_UP:]
    return FrontDoor(what, counted, 1000.0 * len(counted) / sum(counted))


_PLANES = RenderSettings(outputs=("bmode", "echo", "transmittance"), encoding=Encoding.FLOAT32)
_STREAMS = {
    "gRPC stream": (RenderSettings(), False),
    "gRPC stream, shared memory": (RenderSettings(), True),
    "gRPC stream, 3 float32 outputs": (_PLANES, False),
    "gRPC stream, 3 float32 outputs, shared memory": (_PLANES, True),
}
DOORS: dict[str, Callable[[RunningServer, FloatArray], FrontDoor]] = {
    **{what: partial(_grpc_stream, what, *how) for what, how in _STREAMS.items()},
    "gRPC unary": _grpc_unary,
    "HTTP raw": partial(_http, "HTTP raw", "application/octet-stream"),
    "HTTP PNG": partial(_http, "HTTP PNG", "image/png"),
}


def _memory_of_workers_mb(pid: int) -> Iterator[float]:
    """Of each process below one that renders, its resident memory with shared pages counted by share."""
    for children in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in children.read_text(encoding="ascii").split():
            with suppress(OSError):
                if Path(f"/proc/{child}/comm").read_text(encoding="ascii").strip() != WORKER:
                    yield from _memory_of_workers_mb(int(child))
                    continue
                rollup = Path(f"/proc/{child}/smaps_rollup").read_text(encoding="ascii")
                if match := re.search(r"^Pss:\s+(\d+) kB", rollup, re.MULTILINE):
                    yield int(match[1]) / 1024.0


COLUMNS = {
    "what": "{what}",
    "Gaussians": "{gaussians:,}",
    "image": "{image}",
    "threads": "{threads}",
    "poses": "{poses}",
    "p50 ms": "{p50_ms:.2f}",
    "p99 ms": "{p99_ms:.2f}",
    "p50 yards": "{p50_yards:.3f}",
    "frames/s": "{frames_per_s:.0f}",
    "above kernel ms": "{above_kernel_ms:.2f}",
}


def bench_frames(output: Path | None, quick: bool) -> None:
    """Print the table; write it as JSON to `output`. `quick` takes few repetitions and leaves the large scene out."""
    report = Report(output, quick)
    repeats = 20 if quick else 200
    threads = torch.get_num_threads()
    rows: list[dict[str, Any]] = []
    memory_mb: dict[str, float] = {}
    report.time_yard()
    for scene in bench_scenes(quick):
        report.tell(f"{scene.gaussian_count:,} Gaussians: kernel ...")
        timings = measure_kernel(scene, sorted({1, threads}), repeats)
        yard = report.time_yard()
        kernel = [_row(scene, yard, one.what, one.threads, one.poses, one.frame_ms) for one in timings]
        kernel_p50 = next(row["p50_ms"] for row in kernel if (row["threads"], row["poses"]) == (threads, 1))
        report.tell(f"{scene.gaussian_count:,} Gaussians: served ...")
        served = measure_served(scene, repeats, "cpu")
        memory_mb[str(scene.gaussian_count)] = served.worker_memory_mb
        yard = report.time_yard()
        rows += kernel
        for door in served.front_doors:
            row = _row(scene, yard, door.what, threads, 1, door.latency_ms)
            rows.append({**row, "frames_per_s": door.frames_per_s, "above_kernel_ms": row["p50_ms"] - kernel_p50})
    document = report.cpu_document(worker_memory_mb=memory_mb, rows=rows)
    names = ("ultragray", "torch", "numpy", "grpc", "uvicorn", "python")
    report.conclude(
        document,
        COLUMNS,
        rows,
        [
            *(f"worker memory with {int(count):,} Gaussians: {mb:.0f} MB" for count, mb in memory_mb.items()),
            ", ".join(f"{name} {document['versions'][name]}" for name in names),
        ],
    )


def _row(
    scene: BenchScene, yard_ms: float, what: str, threads: int, poses: int, frame_ms: list[float]
) -> dict[str, Any]:
    """One measurement: times per frame of `poses` rendered together; `above_kernel_ms` is for front doors."""
    p50, p99 = percentiles(frame_ms, 50, 99)
    return {
        "what": what,
        "gaussians": scene.gaussian_count,
        "image": f"{scene.height}x{scene.width}",
        "threads": threads,
        "poses": poses,
        "p50_ms": p50,
        "p99_ms": p99,
        "p50_yards": p50 / yard_ms,
        "frames_per_s": 1000.0 / p50,
        "above_kernel_ms": None,
    }

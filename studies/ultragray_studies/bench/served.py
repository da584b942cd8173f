"""`ultragray bench`: the cost of a frame in the kernel and through each front door, here and now.

Machines drift, so every time is also given in yards, a fixed piece of work timed in the same run (docs/physics.md §5).
"""

from __future__ import annotations

import http.client
import json
import mmap
import os
import queue
import re
import secrets
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import grpc
import torch

from ultragray.geometry.probe import FloatArray
from ultragray_proto.v1 import geometry_pb2, rendering_pb2, rendering_pb2_grpc
from ultragray_service.cli.connection import Connection
from ultragray_service.rpc.shared_memory import FOLDER, FREE, HEADER_BYTES, TOKEN_BYTES
from ultragray_studies.bench.kernel import BenchScene, bench_poses, bench_scenes, measure_kernel, time_ms
from ultragray_studies.bench.report import Report, percentiles
from ultragray_workers.errors import NotReady
from ultragray_workers.jobs.worker.process import account_of

_SLOT_BYTES = 4 * 2**20


class SharedFile:
    """A client's side of shared memory, as rendering.proto has it; the service removes the name of the file."""

    def __init__(self, slots: int) -> None:
        self.message = rendering_pb2.SharedMemory(
            name=f"ultragray-{secrets.token_hex(16)}",
            token=secrets.token_bytes(TOKEN_BYTES),
            slots=slots,
            slot_bytes=_SLOT_BYTES,
        )
        size = HEADER_BYTES + slots * _SLOT_BYTES
        descriptor = os.open(f"{FOLDER}/{self.message.name}", os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        os.ftruncate(descriptor, size)
        os.pwrite(descriptor, self.message.token + FREE * slots, 0)
        self._map = mmap.mmap(descriptor, size)
        os.close(descriptor)

    def free(self, data: rendering_pb2.SharedData) -> None:
        """The client has looked at the pixels where they lie."""
        self._map[TOKEN_BYTES + data.slot : TOKEN_BYTES + data.slot + 1] = FREE


# Latency and rate through each front door of a real server in a process of its own.


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
            return Served(doors, max(map(_memory_mb, _descendants(server.pid)), default=0.0))


@dataclass(frozen=True)
class RunningServer:
    """A server of the benchmark."""

    http_port: int
    grpc_port: int
    igtl_port: int
    pid: int
    ready_s: float  # from its start until it was ready

    def connection(self) -> Connection:
        """A connection over HTTP."""
        return Connection(f"http://127.0.0.1:{self.http_port}")


@contextmanager
def running_server(
    folder: Path, backend: str, scene: str, *, job_threads: int = 0, python: str = sys.executable
) -> Iterator[RunningServer]:
    """A service at rest of the scenes in `folder`, `scene` for OpenIGTLink, run by `python`. Raises NotReady."""
    http_port, grpc_port, igtl_port = _free_port(), _free_port(), _free_port()
    settings = {
        "ULTRAGRAY_DATA_FOLDER": str(folder),
        "ULTRAGRAY_HTTP_PORT": str(http_port),
        "ULTRAGRAY_GRPC_PORT": str(grpc_port),
        "ULTRAGRAY_IGTL_PORT": str(igtl_port),
        "ULTRAGRAY_IGTL_SCENE": scene,
        "ULTRAGRAY_TRAINING_THREADS": str(job_threads),
        "ULTRAGRAY_BACKEND": backend,
        "ULTRAGRAY_PRELOAD": scene,
        "ULTRAGRAY_LOG_LEVEL": "error",
    }
    started = time.perf_counter()
    process = subprocess.Popen([python, "-m", "ultragray_service"], env={**os.environ, **settings})
    try:
        _wait_ready(process, http_port)
        ready_s = time.perf_counter() - started
        _wait_settled(process.pid)
        yield RunningServer(http_port, grpc_port, igtl_port, process.pid, ready_s)
    finally:
        process.terminate()
        process.wait(timeout=30)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _wait_ready(process: subprocess.Popen[bytes], port: int) -> None:
    end = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < end and process.poll() is None:
        with suppress(OSError), closing(http.client.HTTPConnection("127.0.0.1", port, timeout=5)) as connection:
            connection.request("GET", "/v1/health/ready")
            if connection.getresponse().status == 200:
                return
        time.sleep(0.1)
    raise NotReady(f"the server of the benchmark was not ready within {START_TIMEOUT_S:g} s")


def _wait_settled(pid: int) -> None:
    """Returns when the worker for jobs has started too, which takes some seconds of both cores. Raises NotReady."""
    end = time.monotonic() + START_TIMEOUT_S
    before = account_of(pid).cpu_s
    while time.monotonic() < end:
        time.sleep(1.0)
        before, used_s = (now := account_of(pid).cpu_s), now - before
        if used_s < SETTLED_SHARE:
            return
    raise NotReady(f"the server of the benchmark did not come to rest within {START_TIMEOUT_S:g} s")


def pose_message(pose: FloatArray) -> geometry_pb2.Pose:  # [4, 4] mm
    """A pose as gRPC takes it."""
    return geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=pose.ravel().tolist()))


def _grpc_stream(
    what: str, outputs: Sequence[str], encoding: str, shares: bool, server: RunningServer, poses: FloatArray
) -> FrontDoor:
    """`shares`: frames come through shared memory."""
    settings = rendering_pb2.RenderSettings(scene=SCENE, outputs=outputs, encoding=encoding)
    with grpc.insecure_channel(f"127.0.0.1:{server.grpc_port}") as channel:
        stub = rendering_pb2_grpc.RenderServiceStub(channel)
        memory, room = SharedFile(2 * IN_FLIGHT) if shares else None, _Turns()
        stream = stub.RenderStream(room.requests(settings, poses, memory))
        latency_ms = []
        for _ in poses:
            started = time.perf_counter()
            room.release()
            _take(next(stream), memory)
            latency_ms.append(1000.0 * (time.perf_counter() - started))
        memory, room = SharedFile(2 * IN_FLIGHT) if shares else None, _Turns()
        started = time.perf_counter()
        stream = stub.RenderStream(room.requests(settings, poses, memory))
        for _ in range(IN_FLIGHT):
            room.release()
        for frame in stream:
            _take(frame, memory)
            room.release()
        rate = len(poses) / (time.perf_counter() - started)
    return FrontDoor(what, latency_ms[WARM_UP:], rate)


class _Turns:
    """A request iterator that yields only after `release`, so that a known number is in flight."""

    def __init__(self) -> None:
        self._turns: queue.Queue[None] = queue.Queue()

    def release(self) -> None:
        self._turns.put(None)

    def requests(
        self, settings: rendering_pb2.RenderSettings, poses: FloatArray, memory: SharedFile | None
    ) -> Iterator[rendering_pb2.RenderStreamRequest]:
        for sequence, pose in enumerate(poses):
            self._turns.get()
            request = rendering_pb2.RenderStreamRequest(sequence=sequence, pose=pose_message(pose))
            if sequence == 0:
                request.settings.CopyFrom(settings)
                if memory is not None:
                    request.shared_memory.CopyFrom(memory.message)
            yield request


def _take(frame: rendering_pb2.Frame, memory: SharedFile | None) -> None:
    """Raises NotReady for an error in place of a frame, and for pixels that do not lie where they should."""
    if frame.HasField("error"):
        raise NotReady(f"the benchmark's frame {frame.sequence} failed: {frame.error.detail}")
    if memory is not None:
        if not frame.HasField("shared_data"):
            raise NotReady(f"the benchmark's frame {frame.sequence} did not come through shared memory")
        memory.free(frame.shared_data)


def _grpc_unary(server: RunningServer, poses: FloatArray) -> FrontDoor:
    settings = rendering_pb2.RenderSettings(scene=SCENE)
    with grpc.insecure_channel(f"127.0.0.1:{server.grpc_port}") as channel:
        stub = rendering_pb2_grpc.RenderServiceStub(channel)
        return _one_by_one(
            "gRPC unary",
            poses,
            lambda pose: stub.Render(rendering_pb2.RenderRequest(settings=settings, pose=pose_message(pose))),
        )


def _http(what: str, media_type: str, server: RunningServer, poses: FloatArray) -> FrontDoor:
    connection = http.client.HTTPConnection("127.0.0.1", server.http_port, timeout=60)
    headers = {"Accept": media_type, "Content-Type": "application/json"}

    def render(pose: FloatArray) -> None:
        body = json.dumps({"pose": {"matrix": pose.tolist()}})
        connection.request("POST", f"/v1/scenes/{SCENE}/render", body, headers)
        response = connection.getresponse()
        data = response.read()
        if response.status != 200:
            raise NotReady(f"the benchmark's frame failed: {data[:500]!r}")

    try:
        return _one_by_one(what, poses, render)
    finally:
        connection.close()


def _one_by_one(what: str, poses: FloatArray, render: Callable[[FloatArray], object]) -> FrontDoor:
    counted = [time_ms(render, pose) for pose in poses][WARM_UP:]
    return FrontDoor(what, counted, 1000.0 * len(counted) / sum(counted))


_BMODE = ("OUTPUT_BMODE",), "ENCODING_UINT8"
_PLANES = ("OUTPUT_BMODE", "OUTPUT_ECHO", "OUTPUT_TRANSMITTANCE"), "ENCODING_FLOAT32"
_STREAMS = {
    "gRPC stream": (*_BMODE, False),
    "gRPC stream, shared memory": (*_BMODE, True),
    "gRPC stream, 3 float32 outputs": (*_PLANES, False),
    "gRPC stream, 3 float32 outputs, shared memory": (*_PLANES, True),
}
DOORS: dict[str, Callable[[RunningServer, FloatArray], FrontDoor]] = {
    **{what: partial(_grpc_stream, what, *how) for what, how in _STREAMS.items()},
    "gRPC unary": _grpc_unary,
    "HTTP raw": partial(_http, "HTTP raw", "application/octet-stream"),
    "HTTP PNG": partial(_http, "HTTP PNG", "image/png"),
}


def _descendants(pid: int) -> list[int]:
    parents = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            status = (folder / "status").read_text()
        except OSError:
            continue
        if match := re.search(r"^PPid:\s+(\d+)", status, re.MULTILINE):
            parents[int(folder.name)] = int(match[1])
    found = [pid]
    for parent in found:
        found += [child for child, of in parents.items() if of == parent]
    return found[1:]


def _memory_mb(pid: int) -> float:
    try:
        rollup = Path(f"/proc/{pid}/smaps_rollup").read_text()
    except OSError:
        return 0.0
    match = re.search(r"^Pss:\s+(\d+) kB", rollup, re.MULTILINE)
    return int(match[1]) / 1024.0 if match else 0.0


# `ultragray bench`: the cost of a frame in the kernel and through each front door, here and now.
#
# Machines drift, so every time is also given in yards, a fixed piece of work timed in the same run (docs/physics.md
# §5).


Row: TypeAlias = dict[str, Any]
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
    rows: list[Row] = []
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
    versions = document["versions"]
    names = ("ultragray", "torch", "numpy", "grpc", "uvicorn", "python")
    report.conclude(
        document,
        COLUMNS,
        rows,
        [
            *(f"worker memory with {int(count):,} Gaussians: {mb:.0f} MB" for count, mb in memory_mb.items()),
            ", ".join(f"{name} {versions[name]}" for name in names),
        ],
    )


def _row(scene: BenchScene, yard_ms: float, what: str, threads: int, poses: int, frame_ms: list[float]) -> Row:
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

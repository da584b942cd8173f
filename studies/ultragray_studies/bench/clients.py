"""Frames as clients get them (`--clients`), and the cost of jobs beside them (`--jobs`)."""

from __future__ import annotations

import http.client
import io
import itertools
import json
import socket
import tempfile
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import sqlalchemy as sa
import torch
from websockets.sync.client import connect

from ultragray.datasets import Dataset
from ultragray.datasets.released import write_released
from ultragray.geometry.probe import FloatArray
from ultragray.phantom import load_phantom
from ultragray.phantom.demo import copy_demo_scene, demo_poses
from ultragray_proto.v1 import rendering_pb2, rendering_pb2_grpc
from ultragray_service.cli.connection import Connection, route
from ultragray_service.igtl.contents import Image, pack_transform, unpack_image, unpack_status
from ultragray_service.igtl.messages import HEADER_BYTES, Message, pack_message, unpack_header, unpack_message
from ultragray_studies.bench.kernel import BenchScene, bench_poses, measure_kernel, time_ms
from ultragray_studies.bench.report import Report, percentiles
from ultragray_studies.bench.served import pose_message, running_server
from ultragray_workers.errors import NotReady
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.tables import JOBS

_TIMEOUT_S = 60.0


class PingPong:
    """One connection to a server on this machine."""

    def __init__(self, port: int, device_name: str) -> None:
        self._device_name = device_name
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=_TIMEOUT_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._file = self._socket.makefile("rb")

    def __enter__(self) -> PingPong:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._socket.close()

    def render(self, pose: FloatArray) -> Image:  # [4, 4] mm
        """The image of a pose, its checksum checked. Raises NotReady where the server answers otherwise."""
        self._socket.sendall(pack_message(Message("TRANSFORM", self._device_name, pack_transform(pose))))
        header = unpack_header(self._file.read(HEADER_BYTES))
        answer = unpack_message(header, self._file.read(header.body_bytes))
        if answer.type_name != "IMAGE":
            raise NotReady(f"the benchmark's image failed: {unpack_status(answer.content).text}")
        return unpack_image(answer.content)


# Frames as clients get them: a control loop, pages that stream, a tracked probe, a script that augments.


SCENE, AUGMENTED = "demo", "augmented"
SIDE = 512
LOOP_HZ = 60.0
PAGES = (1, 8)  # WebSocket clients at the same time
_IN_FLIGHT = 4  # frames of each of them
_POLL_S = 0.1
_WAIT_S = 600.0


@dataclass(frozen=True)
class ClientsExtent:
    """The extent of the measurements."""

    loop_s: float = 60.0
    stream_s: float = 10.0
    ping_pongs: int = 500
    frames: int = 10_000  # of the augmentation
    gaussians: int = 90_000
    kernel_repeats: int = 200
    side: int = SIDE


def measure_clients(extent: ClientsExtent, tell: Callable[[str], None]) -> dict[str, dict[str, float]]:
    """Figures by client. Raises NotReady where the service does not do its part."""
    measured: dict[str, dict[str, float]] = {}
    threads = torch.get_num_threads()
    bench = BenchScene(extent.gaussians, 0.05, extent.side, extent.side)
    with tempfile.TemporaryDirectory(prefix="ultragray-bench-") as name:
        folder = Path(name)
        copy_demo_scene(folder / f"{SCENE}.ugr")
        bench.scene.save(folder / f"{AUGMENTED}.ugr")
        with running_server(folder, "cpu", SCENE, job_threads=threads) as server:
            tell(f"a control loop at {LOOP_HZ:g} Hz for {extent.loop_s:g} s ...")
            measured["control loop"] = _control_loop(server.grpc_port, extent)
            for pages in PAGES:
                tell(f"{pages} WebSocket client(s) ...")
                measured[f"WebSocket, {pages} client(s)"] = _stream_to_pages(server.http_port, pages, extent)
            tell("OpenIGTLink, one pose after another ...")
            measured["OpenIGTLink"] = _ping_pong(server.igtl_port, extent.ping_pongs)
            tell(f"{extent.frames:,} frames to an archive ...")
            frames_per_s = _augment(server.connection(), extent)
        tell("the kernel by itself ...")
        timings = measure_kernel(bench, [threads], extent.kernel_repeats)
        kernel_frames_per_s = max(1000.0 / float(np.median(timing.frame_ms)) for timing in timings)
    measured["augmentation"] = {
        "frames_per_s": frames_per_s,
        "kernel_frames_per_s": kernel_frames_per_s,
        "share_of_kernel": frames_per_s / kernel_frames_per_s,
    }
    return measured


def bench_clients(output: Path | None, quick: bool) -> None:
    """Measure what each kind of client gets of a served demo scene."""
    report = Report(output, quick)
    short = ClientsExtent(loop_s=5.0, stream_s=2.0, ping_pongs=100, frames=500, kernel_repeats=50)
    extent = short if quick else ClientsExtent()
    report.time_yard()
    measured = measure_clients(extent, report.tell)
    report.time_yard()
    report.conclude(
        report.cpu_document(extent=asdict(extent), clients=measured),
        {"client": "{client}", "figure": "{figure}", "": "{value:,.2f}"},
        [
            {"client": client, "figure": figure, "value": value}
            for client, figures in measured.items()
            for figure, value in figures.items()
        ],
    )


def _percentiles(times_ms: list[float]) -> dict[str, float]:
    wanted = (50, 99, 99.9)
    return {f"p{q:g}_ms": value for q, value in zip(wanted, percentiles(times_ms, *wanted), strict=True)}


def _control_loop(port: int, extent: ClientsExtent) -> dict[str, float]:
    """A pose every 1/60 s, whether frames come or not; latency from the sending of a pose to its frame."""
    poses = demo_poses(200)
    count = max(2, round(LOOP_HZ * extent.loop_s))

    def messages() -> Iterator[rendering_pb2.RenderStreamRequest]:
        settings = rendering_pb2.RenderSettings(scene=SCENE, height=extent.side, width=extent.side)
        yield rendering_pb2.RenderStreamRequest(settings=settings, mode=rendering_pb2.STREAM_MODE_LATEST)
        started = time.perf_counter()
        for tick in range(count):
            time.sleep(max(0.0, started + tick / LOOP_HZ - time.perf_counter()))
            pose = pose_message(poses[tick % len(poses)])
            yield rendering_pb2.RenderStreamRequest(sequence=tick, pose=pose, client_time_ns=time.perf_counter_ns())

    latency_ms, arrived_s, dropped = [], [], 0
    with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
        for frame in rendering_pb2_grpc.RenderServiceStub(channel).RenderStream(messages()):
            if frame.HasField("error"):
                raise NotReady(f"the benchmark's frame {frame.sequence} failed: {frame.error.detail}")
            latency_ms.append((time.perf_counter_ns() - frame.client_time_ns) / 1e6)
            arrived_s.append(time.perf_counter())
            dropped += frame.dropped
    return {
        **_percentiles(latency_ms),
        "jitter_ms": float(1000.0 * np.std(np.diff(arrived_s))),  # of the time between two frames
        "frames_per_s": (len(arrived_s) - 1) / (arrived_s[-1] - arrived_s[0]),
        "dropped": float(dropped),
    }


def _stream_to_pages(port: int, pages: int, extent: ClientsExtent) -> dict[str, float]:
    """Frames per second to all of them together, each with a few in flight."""
    ready, counts = threading.Barrier(pages), [0.0] * pages

    def page(number: int) -> None:
        address = f"ws://127.0.0.1:{port}/v1/scenes/{SCENE}/stream"
        with connect(address, compression=None, max_size=None) as connection:
            settings = {"settings": {"height": extent.side, "width": extent.side}}
            poses = [json.dumps({"pose": {"matrix": pose.tolist()}}) for pose in demo_poses(50)]
            connection.send(json.dumps(settings))
            for pose in poses[:_IN_FLIGHT]:
                connection.send(pose)
            connection.recv()
            ready.wait()
            frames, started = 0, time.perf_counter()
            while time.perf_counter() - started < extent.stream_s:
                connection.send(poses[frames % len(poses)])
                if isinstance(answer := connection.recv(), str):
                    raise NotReady(f"the benchmark's frame failed: {answer}")
                frames += 1
            counts[number] = frames / (time.perf_counter() - started)

    threads = [threading.Thread(target=page, args=(number,)) for number in range(pages)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return {"frames_per_s": sum(counts), "least_frames_per_s": min(counts)}


def _ping_pong(port: int, repeats: int) -> dict[str, float]:
    poses: FloatArray = demo_poses(50)
    with PingPong(port, SCENE) as client:
        return _percentiles([time_ms(client.render, poses[number % len(poses)]) for number in range(repeats)])


def _augment(client: Connection, extent: ClientsExtent) -> float:
    """Frames per second of a rendering job, from its start to the whole archive."""
    specification = {
        "scene": AUGMENTED,
        "poses": bench_poses(100).tolist(),
        "sampler": {"kind": "around", "count": extent.frames},
        "height": extent.side,
        "width": extent.side,
        "dtype": "uint8",
        "format": "npz",
    }
    job: dict[str, Any] = client.json("POST", "/v1/jobs", {"kind": "render", "specification": specification})
    end = time.monotonic() + _WAIT_S
    while job["finished_at"] is None:
        if time.monotonic() > end:
            raise NotReady(f"the benchmark's rendering took more than {_WAIT_S:g} s")
        time.sleep(_POLL_S)
        job = client.json("GET", route("jobs", job["id"]))
    if job["state"] != "succeeded":
        raise NotReady(f"the benchmark's rendering {job['state']}: {job['reason']}")
    started, finished = (datetime.fromisoformat(job[name]) for name in ("started_at", "finished_at"))
    return extent.frames / (finished - started).total_seconds()


# The cost of jobs: a page of a long list, the start of a service that has one, and frames beside a training.


SCENE = "demo"
JOBS_SIDE = 512
PAGE = 50
WAIT_S = 120.0
STEPS = 1_000_000  # of a training that does not end by itself
REST_S = 1.0  # until the process of a cancelled training has gone
_COPIED_AT_ONCE = 500


@dataclass(frozen=True)
class JobsExtent:
    """The extent of the measurements."""

    jobs: int = 10_000
    pages: int = 200
    rounds: int = 5  # without and with a training, in turn
    seconds: float = 10.0  # each
    side: int = JOBS_SIDE


def measure_jobs(extent: JobsExtent, tell: Callable[[str], None]) -> dict[str, Any]:
    """`latency_ms` of pages and frames, `start_s`, `p99_ratio`. Raises NotReady where the service fails."""
    with tempfile.TemporaryDirectory(prefix="ultragray-bench-") as name:
        folder = Path(name)
        copy_demo_scene(folder / f"{SCENE}.ugr")
        tell("one job, which is then copied ...")
        with running_server(folder, "cpu", SCENE) as server:
            _finish_one(server.connection())
        _copy_jobs(folder / "artifacts", extent.jobs)
        tell(f"start with {extent.jobs:,} jobs, and pages of them ...")
        with running_server(folder, "cpu", SCENE) as server:
            start_s = server.ready_s
            port, client = server.http_port, server.connection()
            pages = {
                f"page of {PAGE}, newest": _pages(port, extent.pages, f"/v1/jobs?page_size={PAGE}"),
                f"page of {PAGE}, in the middle": _pages(port, extent.pages, _middle(port, extent.jobs)),
            }
            tell("frames without and with a training ...")
            frames = _frames_beside_training(client, port, server.grpc_port, extent)
    latency_ms = {what: _page_percentiles(times) for what, times in pages.items()} | {
        what: {q: float(np.median([_page_percentiles(times)[q] for times in rounds])) for q in ("p50", "p99")}
        for what, rounds in frames.items()
    }
    without, beside = (latency_ms[what]["p99"] for what in frames)
    return {"latency_ms": latency_ms, "start_s": start_s, "p99_ratio": beside / without}


def _page_percentiles(times_ms: list[float]) -> dict[str, float]:
    return dict(zip(("p50", "p99"), percentiles(times_ms, 50, 99), strict=True))


def bench_jobs(output: Path | None, quick: bool) -> None:
    """Measure a full list of jobs, the start of a service that has one, and frames while a training runs."""
    report = Report(output, quick)
    extent = JobsExtent(rounds=2, seconds=4.0) if quick else JobsExtent()
    report.time_yard()
    measured = measure_jobs(extent, report.tell)
    report.time_yard()
    report.conclude(
        report.cpu_document(extent=asdict(extent), **measured),
        {"": "{what}", "p50 ms": "{p50:.2f}", "p99 ms": "{p99:.2f}"},
        [{"what": what, **times} for what, times in measured["latency_ms"].items()],
        [
            f"ready with {extent.jobs:,} jobs after {measured['start_s']:.2f} s",
            f"p99 of frames with a training over that without: {measured['p99_ratio']:.2f}",
        ],
    )


def _finish_one(client: Connection) -> None:
    specification = {"scene": SCENE, "sampler": {"kind": "training"}, "height": 8, "width": 8}
    job = client.json("POST", "/v1/jobs", {"kind": "render", "specification": specification})
    _until(client, job["id"], lambda job: job["state"] == "succeeded")


def _until(client: Connection, job_id: str, reached: Callable[[dict[str, Any]], bool]) -> None:
    end = time.monotonic() + WAIT_S
    while not reached(job := client.json("GET", route("jobs", job_id))):
        if time.monotonic() > end or job["state"] == "failed":
            raise NotReady(f"the job of the benchmark is {job['state']}: {job['reason']}")
        time.sleep(0.1)


def _copy_jobs(artifact_folder: Path, count: int) -> None:
    """Insert copies of the finished job, a second apart before it; they have no folders, which lists do not read."""
    jobs = JobDatabase(artifact_folder, None)
    try:
        with jobs.engine.begin() as connection:
            original = connection.execute(sa.select(JOBS)).mappings().one()
            copies = [_copy(dict(original), number) for number in range(1, count)]
            for first in range(0, len(copies), _COPIED_AT_ONCE):
                connection.execute(sa.insert(JOBS), copies[first : first + _COPIED_AT_ONCE])
    finally:
        jobs.close()


def _copy(row: dict[str, Any], number: int) -> dict[str, Any]:
    earlier = {name: row[name] - 1000 * number for name in ("created_ms", "started_ms", "finished_ms")}
    return {**row, **earlier, "number": -number, "id": f"{number:024x}"}


def _pages(port: int, repeats: int, route: str) -> list[float]:
    times_ms = []
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=WAIT_S)) as connection:
        for _ in range(repeats):
            started = time.perf_counter()
            connection.request("GET", route)
            answer = connection.getresponse()
            content = answer.read()
            times_ms.append(1000.0 * (time.perf_counter() - started))
            if answer.status != 200 or len(json.loads(content)["jobs"]) != PAGE:
                raise NotReady(f"the benchmark's page failed: {content[:500]!r}")
    return times_ms


def _middle(port: int, jobs: int) -> str:
    """The route of a page in the middle of the list."""
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=WAIT_S)) as connection:
        connection.request("GET", f"/v1/jobs?page_size={min(1000, jobs // 2)}")
        token = json.load(connection.getresponse())["next_page_token"]
    return f"/v1/jobs?page_size={PAGE}&page_token={token}"


def _frames_beside_training(
    client: Connection, http_port: int, grpc_port: int, extent: JobsExtent
) -> dict[str, list[list[float]]]:
    """Latencies of gRPC unary frames, one after another; a list for each round."""
    _upload(http_port, load_phantom())
    frames: dict[str, list[list[float]]] = {"frame, alone": [], "frame, beside a training": []}
    with grpc.insecure_channel(f"127.0.0.1:{grpc_port}") as channel:
        stub = rendering_pb2_grpc.RenderServiceStub(channel)
        for number in range(extent.rounds):
            frames["frame, alone"].append(_render_for(stub, extent))
            settings = {"steps": STEPS}
            specification = {"dataset": "phantom", "scene": f"beside-{number}", "settings": settings}
            job = client.json("POST", "/v1/jobs", {"kind": "train", "specification": specification})
            _until(client, job["id"], lambda job: bool(job["progress"]["step"]))
            frames["frame, beside a training"].append(_render_for(stub, extent))
            client.json("POST", route("jobs", job["id"], suffix=":cancel"))
            time.sleep(REST_S)
    return frames


def _render_for(stub: rendering_pb2_grpc.RenderServiceStub, extent: JobsExtent) -> list[float]:
    settings = rendering_pb2.RenderSettings(scene=SCENE, height=extent.side, width=extent.side)
    times_ms: list[float] = []
    end = time.monotonic() + extent.seconds
    for pose in itertools.cycle(map(pose_message, demo_poses(50))):
        if time.monotonic() > end and times_ms:
            break
        times_ms.append(time_ms(stub.Render, rendering_pb2.RenderRequest(settings=settings, pose=pose)))
    return times_ms


def _upload(port: int, dataset: Dataset) -> None:
    packed = io.BytesIO()
    with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(packed, "w") as archive:
        write_released(dataset, folder)
        for path in Path(folder).iterdir():
            archive.write(path, path.name)
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=WAIT_S)) as connection:
        connection.request("PUT", "/v1/datasets/phantom", packed.getvalue(), {"Content-Type": "application/zip"})
        answer = connection.getresponse()
        content = answer.read()
    if answer.status != 201:
        raise NotReady(f"the benchmark's dataset was refused: {content[:500]!r}")

"""Frames as clients get them: a control loop, pages that stream, a tracked probe, a script that augments."""

from __future__ import annotations

import json
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import torch
from websockets.sync.client import connect

from ultragray.geometry.probe import FloatArray
from ultragray.phantom.demo import copy_demo_scene, demo_poses
from ultragray_proto.v1 import rendering_pb2, rendering_pb2_grpc
from ultragray_service.bench.igtl import PingPong
from ultragray_service.bench.kernel import BenchScene, bench_poses, measure_kernel, time_ms
from ultragray_service.bench.report import Report, percentiles
from ultragray_service.bench.served import pose_message, running_server
from ultragray_service.remote.jobs import Jobs
from ultragray_workers.errors import NotReady

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
            frames_per_s = _augment(server.jobs(), extent)
        tell("the kernel by itself ...")
        timings = measure_kernel(bench, [threads], extent.kernel_repeats)
        kernel_frames_per_s = max(1000.0 / float(np.median(timing.frame_ms)) for timing in timings)
    measured["augmentation"] = {
        "frames_per_s": frames_per_s,
        "kernel_frames_per_s": kernel_frames_per_s,
        "share_of_kernel": frames_per_s / kernel_frames_per_s,
    }
    return measured


def run(output: Path | None, quick: bool) -> None:
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


def _augment(client: Jobs, extent: ClientsExtent) -> float:
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
    job: dict[str, Any] = client.submit({"kind": "render", "specification": specification})[0]
    end = time.monotonic() + _WAIT_S
    while job["finished_at"] is None:
        if time.monotonic() > end:
            raise NotReady(f"the benchmark's rendering took more than {_WAIT_S:g} s")
        time.sleep(_POLL_S)
        job = client.get(job["id"])
    if job["state"] != "succeeded":
        raise NotReady(f"the benchmark's rendering {job['state']}: {job['reason']}")
    started, finished = (datetime.fromisoformat(job[name]) for name in ("started_at", "finished_at"))
    return extent.frames / (finished - started).total_seconds()

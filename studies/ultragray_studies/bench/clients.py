"""Frames as clients get them (`--clients`), and the cost of jobs beside them (`--jobs`)."""

from __future__ import annotations

import http.client
import itertools
import json
import socket
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import sqlalchemy as sa
import torch
from websockets.sync.client import connect

from ultragray.datasets.released import write_released
from ultragray.geometry.probe import FloatArray
from ultragray.phantom import load_phantom
from ultragray.phantom.demo import copy_demo_scene, demo_poses
from ultragray_client import AroundSampler, Client, Job, JobState, RenderJob, RenderSettings, TrainingSampler, TrainJob
from ultragray_service.igtl.contents import pack_transform, unpack_image, unpack_status
from ultragray_service.igtl.messages import HEADER_BYTES, Message, pack_message, unpack_header, unpack_message
from ultragray_studies.bench.kernel import BenchScene, bench_poses, measure_kernel, time_ms
from ultragray_studies.bench.report import Report, percentiles
from ultragray_studies.bench.served import RunningServer, running_server
from ultragray_workers.errors import NotReady
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.tables import JOBS

SCENE, AUGMENTED = "demo", "augmented"
SIDE = 512
LOOP_HZ = 60.0
CLIENTS = (1, 8)  # of the WebSocket at the same time
IN_FLIGHT = 4  # frames of each of them
PAGE = 50  # jobs
WAIT_S = 600.0
STEPS = 1_000_000  # of a training that does not end by itself
REST_S = 1.0  # until the process of a cancelled training has gone


# Frames as clients get them: a control loop, pages that stream, a tracked probe, a script that augments.


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
        with running_server(folder, "cpu", SCENE, job_threads=threads) as server, server.client() as client:
            tell(f"a control loop at {LOOP_HZ:g} Hz for {extent.loop_s:g} s ...")
            measured["control loop"] = _control_loop(client, extent)
            for count in CLIENTS:
                tell(f"{count} WebSocket client(s) ...")
                measured[f"WebSocket, {count} client(s)"] = _stream_to_pages(server, count, extent)
            tell("OpenIGTLink, one pose after another ...")
            measured["OpenIGTLink"] = _ping_pong(server.igtl_port, extent.ping_pongs)
            tell(f"{extent.frames:,} frames to an archive ...")
            frames_per_s = _augment(client, extent)
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


def _percentiles(times_ms: list[float], *wanted: float, suffix: str = "") -> dict[str, float]:
    return {f"p{q:g}{suffix}": value for q, value in zip(wanted, percentiles(times_ms, *wanted), strict=True)}


def _control_loop(client: Client, extent: ClientsExtent) -> dict[str, float]:
    """A pose every 1/60 s, whether frames come or not; latency from the sending of a pose to its frame."""
    poses = itertools.cycle(demo_poses(200))
    count = max(2, round(LOOP_HZ * extent.loop_s))
    latency_ms, arrived_s, dropped = [], [], 0
    with client.stream(SCENE, RenderSettings(height=extent.side, width=extent.side), mode="latest") as stream:

        def send() -> None:
            started = time.perf_counter()
            for tick in range(count):
                time.sleep(max(0.0, started + tick / LOOP_HZ - time.perf_counter()))
                stream.send(next(poses))
            stream.done_sending()

        threading.Thread(target=send, daemon=True).start()
        for frame in stream:
            arrived_s.append(time.perf_counter())
            latency_ms.append(frame.latency_ms or 0.0)
            dropped += frame.dropped
    return {
        **_percentiles(latency_ms, 50, 99, 99.9, suffix="_ms"),
        "jitter_ms": float(1000.0 * np.std(np.diff(arrived_s))),  # of the time between two frames
        "frames_per_s": (len(arrived_s) - 1) / (arrived_s[-1] - arrived_s[0]),
        "dropped": float(dropped),
    }


def _stream_to_pages(server: RunningServer, pages: int, extent: ClientsExtent) -> dict[str, float]:
    """Frames per second to all of them together, each with a few in flight."""
    ready, counts = threading.Barrier(pages), [0.0] * pages

    def page(number: int) -> None:
        address = f"ws://127.0.0.1:{server.http_port}/v1/scenes/{SCENE}/stream"
        with connect(address, compression=None, max_size=None) as connection:
            poses = [json.dumps({"pose": {"matrix": pose.tolist()}}) for pose in demo_poses(50)]
            connection.send(json.dumps({"settings": {"height": extent.side, "width": extent.side}}))
            for pose in poses[:IN_FLIGHT]:
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
    """Images over OpenIGTLink, their checksums checked. Raises NotReady where the server answers otherwise."""
    with socket.create_connection(("127.0.0.1", port), timeout=60.0) as connection, connection.makefile("rb") as file:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

        def render(pose: FloatArray) -> None:
            connection.sendall(pack_message(Message("TRANSFORM", SCENE, pack_transform(pose))))
            header = unpack_header(file.read(HEADER_BYTES))
            answer = unpack_message(header, file.read(header.body_bytes))
            if answer.type_name != "IMAGE":
                raise NotReady(f"the benchmark's image failed: {unpack_status(answer.content).text}")
            unpack_image(answer.content)

        poses = itertools.islice(itertools.cycle(demo_poses(50)), repeats)
        return _percentiles([time_ms(render, pose) for pose in poses], 50, 99, 99.9, suffix="_ms")


def _augment(client: Client, extent: ClientsExtent) -> float:
    """Frames per second of a rendering job, from its start to the whole archive."""
    sampler = AroundSampler(count=extent.frames)
    job = _finished(
        client,
        RenderJob(
            scene=AUGMENTED,
            poses=bench_poses(100),
            sampler=sampler,
            dtype="uint8",
            height=extent.side,
            width=extent.side,
        ),
    )
    started, finished = (datetime.fromisoformat(at or "") for at in (job.started_at, job.finished_at))
    return extent.frames / (finished - started).total_seconds()


def _finished(client: Client, specification: RenderJob) -> Job:
    job: Job = client.jobs.wait(client.jobs.submit(specification).id, timeout_s=WAIT_S)
    if job.state is not JobState.SUCCEEDED:
        raise NotReady(f"the job of the benchmark is {job.state.value}: {job.error}")
    return job


# The cost of jobs: a page of a long list, the start of a service that has one, and frames beside a training.


@dataclass(frozen=True)
class JobsExtent:
    """The extent of the measurements."""

    jobs: int = 10_000
    pages: int = 200
    rounds: int = 5  # without and with a training, in turn
    seconds: float = 10.0  # each
    side: int = SIDE


def measure_jobs(extent: JobsExtent, tell: Callable[[str], None]) -> dict[str, Any]:
    """`latency_ms` of pages and frames, `start_s`, `p99_ratio`. Raises NotReady where the service fails."""
    with tempfile.TemporaryDirectory(prefix="ultragray-bench-") as name:
        folder = Path(name)
        copy_demo_scene(folder / f"{SCENE}.ugr")
        tell("one job, which is then copied ...")
        with running_server(folder, "cpu", SCENE) as server, server.client() as client:
            _finished(client, RenderJob(scene=SCENE, sampler=TrainingSampler(), height=8, width=8))
        _copy_jobs(folder / "artifacts", extent.jobs)
        tell(f"start with {extent.jobs:,} jobs, and pages of them ...")
        with running_server(folder, "cpu", SCENE) as server, server.client() as client:
            with server.http() as connection:
                first, _ = _page(connection, f"page_size={min(1000, extent.jobs // 2)}")
                places = {"newest": "", "in the middle": f"&page_token={first['next_page_token']}"}
                latency_ms = {
                    f"page of {PAGE}, {where}": _percentiles(
                        [_page(connection, f"page_size={PAGE}{token}")[1] for _ in range(extent.pages)], 50, 99
                    )
                    for where, token in places.items()
                }
            tell("frames without and with a training ...")
            frames = _frames_beside_training(client, extent)
    for what, rounds in frames.items():
        each = [_percentiles(times, 50, 99) for times in rounds]
        latency_ms[what] = {q: float(np.median([one[q] for one in each])) for q in each[0]}
    without, beside = (latency_ms[what]["p99"] for what in frames)
    return {"latency_ms": latency_ms, "start_s": server.ready_s, "p99_ratio": beside / without}


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


def _copy_jobs(artifact_folder: Path, count: int) -> None:
    """Insert copies of the finished job, a second apart before it; they have no folders, which lists do not read."""
    with closing(JobDatabase(artifact_folder, None)) as jobs, jobs.engine.begin() as connection:
        original = dict(connection.execute(sa.select(JOBS)).mappings().one())
        times = ("created_ms", "started_ms", "finished_ms")
        copies = [
            {**original, **{name: original[name] - 1000 * number for name in times}}
            | {"number": original["number"] + number, "id": f"{number:024x}"}
            for number in range(1, count)
        ]
        connection.execute(sa.insert(JOBS), copies)


def _page(connection: http.client.HTTPConnection, query: str) -> tuple[dict[str, Any], float]:
    """A page of the list of jobs, and the time that it took, ms."""
    started = time.perf_counter()
    connection.request("GET", f"/v1/jobs?{query}")
    answer = connection.getresponse()
    content = answer.read()
    took_ms = 1000.0 * (time.perf_counter() - started)
    if answer.status != 200 or not (page := json.loads(content))["jobs"]:
        raise NotReady(f"the benchmark's page failed: {content[:500]!r}")
    return page, took_ms


def _frames_beside_training(client: Client, extent: JobsExtent) -> dict[str, list[list[float]]]:
    """Latencies of gRPC unary frames, one after another; a list for each round."""
    with tempfile.TemporaryDirectory() as folder:
        write_released(load_phantom(), folder)
        client.datasets.upload("phantom", folder)
    frames: dict[str, list[list[float]]] = {"frame, alone": [], "frame, beside a training": []}
    for number in range(extent.rounds):
        frames["frame, alone"].append(_render_for(client, extent))
        job = client.jobs.submit(TrainJob(dataset="phantom", scene=f"beside-{number}", settings={"steps": STEPS}))
        for event in client.jobs.watch(job.id):
            if event.job is not None and event.job.progress.step:
                break
        frames["frame, beside a training"].append(_render_for(client, extent))
        client.jobs.cancel(job.id)
        time.sleep(REST_S)
    return frames


def _render_for(client: Client, extent: JobsExtent) -> list[float]:
    settings = RenderSettings(height=extent.side, width=extent.side)
    times_ms: list[float] = []
    end = time.monotonic() + extent.seconds
    for pose in itertools.cycle(demo_poses(50)):
        if time.monotonic() > end and times_ms:
            break
        times_ms.append(time_ms(client.render, SCENE, pose, settings))
    return times_ms

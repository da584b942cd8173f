"""The cost of jobs: a page of a long list, the start of a service that has one, and frames beside a training."""

from __future__ import annotations

import http.client
import io
import itertools
import json
import tempfile
import time
import zipfile
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import sqlalchemy as sa

from ultragray.datasets import Dataset
from ultragray.datasets.released import write_released
from ultragray.phantom import load_phantom
from ultragray.phantom.demo import copy_demo_scene, demo_poses
from ultragray_proto.v1 import rendering_pb2, rendering_pb2_grpc
from ultragray_service.bench.kernel import time_ms
from ultragray_service.bench.report import Report, percentiles
from ultragray_service.bench.served import pose_message, running_server
from ultragray_service.remote.jobs import Jobs
from ultragray_workers.errors import NotReady
from ultragray_workers.jobs.database import JobDatabase

SCENE = "demo"
SIDE = 512
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
    side: int = SIDE


def measure_jobs(extent: JobsExtent, tell: Callable[[str], None]) -> dict[str, Any]:
    """`latency_ms` of pages and frames, `start_s`, `p99_ratio`. Raises NotReady where the service fails."""
    with tempfile.TemporaryDirectory(prefix="ultragray-bench-") as name:
        folder = Path(name)
        copy_demo_scene(folder / f"{SCENE}.ugr")
        tell("one job, which is then copied ...")
        with running_server(folder, "cpu", SCENE) as server:
            _finish_one(server.jobs())
        _copy_jobs(folder / "artifacts", extent.jobs)
        tell(f"start with {extent.jobs:,} jobs, and pages of them ...")
        with running_server(folder, "cpu", SCENE) as server:
            start_s = server.ready_s
            port, client = server.http_port, server.jobs()
            pages = {
                f"page of {PAGE}, newest": _pages(port, extent.pages, f"/v1/jobs?page_size={PAGE}"),
                f"page of {PAGE}, in the middle": _pages(port, extent.pages, _middle(port, extent.jobs)),
            }
            tell("frames without and with a training ...")
            frames = _frames_beside_training(client, port, server.grpc_port, extent)
    latency_ms = {what: _percentiles(times) for what, times in pages.items()} | {
        what: {q: float(np.median([_percentiles(times)[q] for times in rounds])) for q in ("p50", "p99")}
        for what, rounds in frames.items()
    }
    without, beside = (latency_ms[what]["p99"] for what in frames)
    return {"latency_ms": latency_ms, "start_s": start_s, "p99_ratio": beside / without}


def _percentiles(times_ms: list[float]) -> dict[str, float]:
    return dict(zip(("p50", "p99"), percentiles(times_ms, 50, 99), strict=True))


def run(output: Path | None, quick: bool) -> None:
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


def _finish_one(client: Jobs) -> None:
    specification = {"scene": SCENE, "sampler": {"kind": "training"}, "height": 8, "width": 8}
    job, _ = client.submit({"kind": "render", "specification": specification})
    _until(client, job["id"], lambda job: job["state"] == "succeeded")


def _until(client: Jobs, job_id: str, reached: Callable[[dict[str, Any]], bool]) -> None:
    end = time.monotonic() + WAIT_S
    while not reached(job := client.get(job_id)):
        if time.monotonic() > end or job["state"] == "failed":
            raise NotReady(f"the job of the benchmark is {job['state']}: {job['reason']}")
        time.sleep(0.1)


def _copy_jobs(artifact_folder: Path, count: int) -> None:
    """Insert copies of the finished job, a second apart before it; they have no folders, which lists do not read."""
    jobs = JobDatabase(artifact_folder, None)
    try:
        tables = sa.MetaData()
        tables.reflect(jobs.engine, only=("workflow_status", "workflow_input", "workflow_output"))
        with jobs.engine.begin() as connection:
            for table in tables.sorted_tables:
                original = connection.execute(sa.select(table)).mappings().first()
                copies = [] if original is None else [_copy(dict(original), number) for number in range(1, count)]
                for first in range(0, len(copies), _COPIED_AT_ONCE):
                    connection.execute(sa.insert(table), copies[first : first + _COPIED_AT_ONCE])
    finally:
        jobs.close()


def _copy(row: dict[str, Any], number: int) -> dict[str, Any]:
    earlier = {
        name: row[name] - 1000 * number for name in ("created_at", "updated_at", "completed_at") if row.get(name)
    }
    return {**row, **earlier, "workflow_uuid": f"{number:024x}"}


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
    client: Jobs, http_port: int, grpc_port: int, extent: JobsExtent
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
            job, _ = client.submit({"kind": "train", "specification": specification})
            _until(client, job["id"], lambda job: bool(job["progress"]["step"]))
            frames["frame, beside a training"].append(_render_for(stub, extent))
            client.cancel(job["id"])
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

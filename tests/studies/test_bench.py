"""`ultragray bench` writes what it prints: parts that add up, counts that one knows by heart, and CUDA interpreted."""

import json
import math
import os
from datetime import datetime

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from ultragray import GaussianScene, LinearProbe, SceneInfo
from ultragray.datasets import Dataset, Sweep
from ultragray.phantom import PHANTOM_PROBE, freehand_poses, simulate
from ultragray.rendering.backends import cpu, cuda
from ultragray_service.cli.app import app
from ultragray_studies.bench import clients, parts, report
from ultragray_studies.bench import parts as bench_train
from ultragray_studies.bench.clients import ClientsExtent, JobsExtent, bench_clients, bench_jobs
from ultragray_studies.bench.kernel import BenchScene
from ultragray_studies.bench.parts import LANES, PARTS, View, bench_kernel_details, bench_training
from ultragray_studies.bench.served import FrontDoor, Served

PROBE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=40.0)


def one_gaussian(sigma_mm):
    """A round one in the middle of the image, that does not absorb."""
    splats = {
        "means": torch.tensor([[0.0, 0.0, 2.0]]),
        "scales": torch.full((1, 3), math.log(sigma_mm / 10.0)),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "transmittances": torch.tensor([20.0]),
        "sh0": torch.zeros(1, 1, 1),
        "shN": torch.zeros(1, 0, 1),
    }
    return GaussianScene.from_splats(splats, info=SceneInfo(probe=PROBE, image_height=80, image_width=80))


@pytest.mark.parametrize("instruction_set", cpu.INSTRUCTION_SETS)
def test_the_work_of_a_gaussian_is_its_footprint(instruction_set):
    scene = one_gaussian(sigma_mm=1.0)
    strips = cpu.drawing_work(scene, PROBE, np.eye(4)[None], 80, 80, instruction_set=instruction_set)
    assert strips["slices"].shape == (1, 2)
    assert strips["slices"].tolist() == [[1, 0]]  # its last scan line is the 47th
    work = {name: counts.sum() for name, counts in strips.items()}
    across = 2 * math.ceil(3.33 / 0.5)  # scan lines within its reach on either side, half a millimetre apart
    assert work["slices"] == 1
    assert across / LANES[instruction_set] <= work["groups"] <= across / LANES[instruction_set] + 2
    assert math.pi * 3.33**2 / 0.25 <= work["lanes"]  # the pixels of the ellipse
    assert work["lanes"] <= work["rows"] * LANES[instruction_set]


def test_bench_of_the_kernels_parts(tmp_path, monkeypatch, capsys):
    def tiny(quick):
        yield View("one", one_gaussian(1.0), PROBE, np.eye(4)[None].repeat(4, 0), 80, 80)

    monkeypatch.setattr(parts, "views", tiny)
    monkeypatch.setattr(report, "time_yard_ms", lambda: 4.0)
    bench_kernel_details(tmp_path / "kernel.json", quick=True)
    rows = json.loads((tmp_path / "kernel.json").read_text())["rows"]
    assert [row["instruction_set"] for row in rows] == list(cpu.INSTRUCTION_SETS)
    for row in rows:
        assert row["slicing_ms"] + row["drawing_ms"] + row["finishing_ms"] == pytest.approx(row["frame_ms"])
        assert 0.0 < row["lanes_used"] <= 1.0
        assert row["modelled_speedups"]["2"] < 2.0  # all of it lies in one of two strips
        assert row["modelled_speedups"]["16"] >= row["modelled_speedups"]["2"]
    printed = capsys.readouterr().out
    assert all(f"{row['groups']:,.0f}" in printed for row in rows)


@pytest.mark.parametrize(("quick", "gaussians"), [(True, [300]), (False, [400, 300])])
def test_training_bench(tmp_path, monkeypatch, capsys, quick, gaussians):
    large, small = BenchScene(400, 0.1, height=24, width=20), BenchScene(300, 0.1, height=24, width=20)
    monkeypatch.setattr(parts, "training_scenes", lambda: [large, small])
    monkeypatch.setattr(report, "time_yard_ms", lambda: 4.0)
    bench_training(tmp_path / "bench.json", quick)
    document = json.loads((tmp_path / "bench.json").read_text())
    assert [row["gaussians"] for row in document["rows"]] == gaussians
    assert document["yard_ms"] == 4.0
    assert document.get("quick", False) == quick
    for row in document["rows"]:
        assert row["images"] == "8 of 24x20"
        assert row["step_yards"] == pytest.approx(row["step_ms"] / 4.0)
        assert list(row["shares"]) == list(PARTS)
        assert all(0.0 <= share <= 1.0 for share in row["shares"].values())
    printed = capsys.readouterr().out
    assert "yard 4.0 ms" in printed
    assert f"{document['rows'][-1]['step_ms']:.0f}" in printed


def small_phantom():
    poses = freehand_poses(8)
    images = simulate(poses, probe=PHANTOM_PROBE, height=32, width=24)
    sweep = Sweep(images, poses, PHANTOM_PROBE, np.arange(8), "phantom")
    return Dataset("phantom", sweep.select([0, 1, 2, 4, 5, 6]), sweep.select([3, 7]))


@pytest.mark.long
def test_bench_of_jobs(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(clients, "load_phantom", small_phantom)
    monkeypatch.setattr(clients, "STEPS", 100_000)
    monkeypatch.setattr(report, "time_yard_ms", lambda: 4.0)
    monkeypatch.setattr(clients, "JobsExtent", lambda **less: JobsExtent(150, 3, 1, 0.3, 32))
    bench_jobs(tmp_path / "jobs.json", quick=True)
    document = json.loads((tmp_path / "jobs.json").read_text())
    assert document["extent"] == {"jobs": 150, "pages": 3, "rounds": 1, "seconds": 0.3, "side": 32}
    assert list(document["latency_ms"]) == [
        "page of 50, newest",
        "page of 50, in the middle",
        "frame, alone",
        "frame, beside a training",
    ]
    assert all(0.0 < times["p50"] <= times["p99"] for times in document["latency_ms"].values())
    frames = [document["latency_ms"][what]["p99"] for what in ("frame, alone", "frame, beside a training")]
    assert document["p99_ratio"] == pytest.approx(frames[1] / frames[0])
    assert "ready with 150 jobs after " in capsys.readouterr().out


@pytest.mark.long
def test_bench_of_clients(tmp_path, monkeypatch):
    tiny = ClientsExtent(loop_s=1.0, stream_s=0.3, ping_pongs=5, frames=12, gaussians=500, kernel_repeats=3, side=32)
    monkeypatch.setattr(report, "time_yard_ms", lambda: 4.0)
    monkeypatch.setattr(clients, "ClientsExtent", lambda **less: tiny)
    bench_clients(tmp_path / "clients.json", quick=True)
    found = json.loads((tmp_path / "clients.json").read_text())["clients"]
    assert list(found) == [
        "control loop",
        "WebSocket, 1 client(s)",
        "WebSocket, 8 client(s)",
        "OpenIGTLink",
        "augmentation",
    ]
    loop, augmentation = found["control loop"], found["augmentation"]
    assert 0 < loop["p50_ms"] <= loop["p99_ms"] <= loop["p99.9_ms"]
    assert loop["frames_per_s"] == pytest.approx(60, rel=0.5)
    assert augmentation["share_of_kernel"] == pytest.approx(
        augmentation["frames_per_s"] / augmentation["kernel_frames_per_s"]
    )


def test_the_head_says_commit_date_and_machine(capsys):
    report.main()
    head = json.loads(capsys.readouterr().out)
    assert list(head) == ["commit", "date", "machine"]
    assert datetime.fromisoformat(head["date"]).tzinfo is not None
    machine = head["machine"]
    assert (machine["threads"], machine["cores"]) == (os.cpu_count(), os.cpu_count())
    assert machine["instruction_set"] == cpu.INSTRUCTION_SETS[0]
    assert machine["memory_gib"] > 0.1
    assert report.measured(1)["machine"] == {**machine, "threads": 1}


TINY = BenchScene(40, 0.2, height=24, width=20)


def served(bench, repeats, backend):
    return Served([FrontDoor(f"HTTP of {backend}", [2.0, 4.0], 9.0)], worker_memory_mb=1.0)


@pytest.fixture(scope="module")
def benched(tmp_path_factory):
    """What the command printed, and its two documents."""
    if not cuda.available():
        pytest.skip("there is no GPU, and Triton is not installed, which could interpret the kernels")
    from ultragray_studies.bench import cuda as bench_cuda

    folder = tmp_path_factory.mktemp("bench")
    printed, documents = "", []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench_cuda, "bench_scenes", lambda quick: [TINY])
        patch.setattr(bench_cuda, "training_scenes", lambda: [TINY, TINY])
        patch.setattr(bench_cuda, "measure_served", served)
        for name, value in {"POSES": 2, "BATCHES": (1, 2), "ROUNDS": 8}.items():
            patch.setattr(bench_cuda, name, value)
        for module in (bench_cuda, bench_train):
            patch.setattr(module, "BATCH", 2)
        patch.setattr(bench_cuda, "STEPS", 20)
        for options in ([], ["--train"]):
            output = folder / "bench.json"
            arguments = ["bench", "--backend", "cuda", "--quick", "--force", "--output", str(output), *options]
            result = CliRunner().invoke(app, arguments)
            assert result.exit_code == 0, result.output
            printed += result.stdout
            documents.append(json.loads(output.read_text()))
    return printed, documents[0], documents[1]


@pytest.mark.long
def test_rates_stand_beside_the_limits(benched):
    printed, document, _ = benched
    *rendered, door = document["rows"]
    work, limits = document["work_per_frame"]["40"], document["limits"]
    assert [(row["poses"], row["what"]) for row in rendered] == [
        (1, "frames on the GPU"),
        (1, "8-bit frames on the host"),
        (2, "frames on the GPU"),
        (2, "8-bit frames on the host"),
    ]
    for row in rendered:
        assert (row["gaussians"], row["image"]) == (40, "24x20")
        assert row["device_frames_per_s"] == pytest.approx(row["frames_per_s"], rel=0.1)
        moved = work["bytes_read"] + work["bytes_written"]
        assert row["bandwidth_share"] == pytest.approx(row["frames_per_s"] * moved / limits["bytes_per_s"])
        assert row["arithmetic_share"] == pytest.approx(
            row["frames_per_s"] * work["operations"] / limits["operations_per_s"]
        )
    assert (door["what"], door["p50_ms"], door["frames_per_s"]) == ("HTTP of cuda", 3.0, 9.0)
    assert door["bandwidth_share"] is None
    assert document["gpu"]["renderer"] == cuda.renderer(cuda.device())
    assert document["gpu"]["triton"]
    assert "HTTP of cuda" in printed
    assert f"{100 * rendered[0]['arithmetic_share']:.1f}%" in printed


@pytest.mark.long
def test_training_step(benched):
    printed, _, document = benched
    (row,) = document["rows"]
    assert row["images"] == "2 of 24x20"
    assert list(row["part_ms"]) == ["forward", "loss", "backward", "optimizer"]
    parts_ms = sum(row["part_ms"].values())
    assert 0.99 * parts_ms < row["step_ms"] < 2.0 * parts_ms
    assert (row["peak_memory_mb"] is None) == cuda.interpreted()
    assert f"{row['step_ms']:.2f}" in printed


def refused(*arguments):
    result = CliRunner().invoke(app, ["bench", *arguments])
    assert result.exit_code == 2, result.output
    (line,) = result.stderr.splitlines()
    return line


@pytest.mark.parametrize("options", [(), ("--train",)])
def test_says_what_is_missing_without_a_gpu(tmp_path, monkeypatch, options):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    output = tmp_path / "cuda.json"
    told = refused("--backend", "cuda", "--output", str(output), *options)
    assert told.startswith("error: backend cuda needs an NVIDIA GPU and torch's CUDA build, but")
    assert not output.exists()


def test_other_backends_are_refused():
    assert refused("--backend", "reference") == "error: backend must be cpu or cuda, got 'reference'"


def test_choices_that_do_not_go_together():
    assert "give one of --train, --jobs, --clients and --kernel-details" in refused("--train", "--clients")
    assert "--jobs goes without --backend" in refused("--jobs", "--backend", "cuda")

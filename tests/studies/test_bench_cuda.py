"""`ultragray bench --backend cuda`: the whole command on the interpreter, and what is said without a GPU."""

import json

import pytest
import torch
from typer.testing import CliRunner

from ultragray.rendering.backends import cuda
from ultragray_service.cli.app import app
from ultragray_studies.bench import parts as bench_train
from ultragray_studies.bench.kernel import BenchScene
from ultragray_studies.bench.served import FrontDoor, Served

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

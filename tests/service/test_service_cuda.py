"""The CUDA backend behind the front doors: interpreted, and where there is no GPU."""

import importlib.util
import os
import subprocess
import sys

import httpx
import numpy as np
import pytest
import torch

from .conftest import ROOT, SOURCE_FOLDERS

needs_triton = pytest.mark.skipif(
    importlib.util.find_spec("triton") is None, reason="the package triton is not installed: no kernels to interpret"
)
needs_no_gpu = pytest.mark.skipif(torch.cuda.is_available(), reason="is about machines without a CUDA device")
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")

WHERE = [  # TRITON_INTERPRET, and what frames say rendered them
    pytest.param("1", "cuda-interpreted", marks=needs_triton, id="interpreted"),
    pytest.param("0", "cuda-sm", marks=[pytest.mark.gpu, needs_gpu], id="gpu"),
]


def render(service, body):
    headers = {"Accept": "application/octet-stream"}
    return httpx.post(f"{service.http}/v1/scenes/demo/render", json=body, headers=headers, timeout=60)


@pytest.mark.parametrize(("interpret", "renderer"), WHERE)
def test_a_service_renders_what_one_on_the_cpu_renders(start_service, pose_body, monkeypatch, interpret, renderer):
    monkeypatch.setenv("TRITON_INTERPRET", interpret)
    services = [start_service(backend=backend, preload="demo") for backend in ("cuda", "cpu")]
    body = {"pose": pose_body, "height": 32, "width": 24}
    answers = [render(one, body) for one in services]
    assert [answer.status_code for answer in answers] == [200, 200]
    assert f" {renderer}" in answers[0].headers["x-ultragray-renderer"]
    cuda, cpu = (np.frombuffer(answer.content, np.uint8).astype(int) for answer in answers)
    assert cpu.max() > 50
    assert np.abs(cuda - cpu).max() <= 1


@needs_no_gpu
def test_a_service_without_a_gpu_says_so_in_one_line(start_service, monkeypatch):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    service = start_service(wait=False, backend="cuda")
    assert service.process.wait(60) == 1
    said = service.log_path.read_text()
    assert "backend cuda needs an NVIDIA GPU" in said.splitlines()[-1]
    assert "Traceback" not in said


def run_render(data_folder, output, interpret):
    program = "from ultragray_service.cli.app import app; app()"
    options = ["-o", str(output), "--backend", "cuda", "--height", "32", "--width", "24"]
    path = os.pathsep.join(str(ROOT / folder) for folder in SOURCE_FOLDERS)
    return subprocess.run(
        [sys.executable, "-c", program, "render", str(data_folder / "demo.ugr"), *options],
        env={**os.environ, "PYTHONPATH": path, "TRITON_INTERPRET": interpret},
        capture_output=True,
        text=True,
    )


@pytest.mark.slow
@needs_no_gpu
def test_the_command_line_without_a_gpu_says_so_in_one_line(data_folder, tmp_path):
    done = run_render(data_folder, tmp_path / "frames.npz", "0")
    assert done.returncode == 2
    assert done.stderr.startswith("error: backend cuda needs an NVIDIA GPU")
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "frames.npz").exists()

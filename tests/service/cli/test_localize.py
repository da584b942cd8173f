"""`ultragray localize`: a frame and a rough pose in, the pose out."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ultragray import render
from ultragray.geometry.probe import FloatArray
from ultragray.phantom.demo import DEMO_FILE, demo_poses, load_demo_scene
from ultragray.rendering.pixels import image_file

from .command_line import refused, run


@pytest.fixture
def frame(tmp_path: Path) -> tuple[Path, FloatArray]:
    """A picture of the demo scene, and its pose; `start.npy` beside it is a few millimetres off."""
    pose: FloatArray = demo_poses(3)[1]
    pixels = render(load_demo_scene(), None, pose, height=192, width=192, outputs=("bmode",))["bmode"][0]
    path = tmp_path / "frame.png"
    path.write_bytes(image_file(pixels.detach().numpy(), ".png").tobytes())
    start = pose.copy()
    start[:3, 3] += (1.5, -1.0, 1.0)
    np.save(tmp_path / "start.npy", start)
    return path, pose


def test_the_pose_is_found_and_written(frame: tuple[Path, FloatArray], tmp_path: Path) -> None:
    path, pose = frame
    found = tmp_path / "found.npy"
    result = run("localize", DEMO_FILE, path, "--start", tmp_path / "start.npy", "-o", found, "--json")
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert document["is_found"]
    np.testing.assert_allclose(document["pose"], pose, atol=0.2)
    np.testing.assert_array_equal(np.load(found), document["pose"])


def test_a_frame_of_something_else_is_not_found(tmp_path: Path) -> None:
    np.save(tmp_path / "noise.npy", np.random.default_rng(0).integers(0, 256, (96, 96), dtype=np.uint8))
    np.save(tmp_path / "start.npy", demo_poses(3)[1])
    found = tmp_path / "found.npy"
    result = run("localize", DEMO_FILE, tmp_path / "noise.npy", "--start", tmp_path / "start.npy", "-o", found)
    assert result.exit_code == 1, result.output
    assert result.stdout.startswith("not found: ")
    assert not found.exists()


def test_mistakes_are_told_in_one_line(tmp_path: Path) -> None:
    start = tmp_path / "start.npy"
    np.save(start, demo_poses(3))
    (tmp_path / "text.png").write_text("no picture")
    (tmp_path / "frame.dcm").touch()
    assert "must hold one pose, got 3" in refused("localize", DEMO_FILE, tmp_path / "text.png", "--start", start)
    np.save(start, demo_poses(1))
    assert "image must be a PNG file" in refused("localize", DEMO_FILE, tmp_path / "text.png", "--start", start)
    assert "must end in .png or .npy" in refused("localize", DEMO_FILE, tmp_path / "frame.dcm", "--start", start)
    assert "No such file" in refused("localize", DEMO_FILE, tmp_path / "gone.png", "--start", start)
    np.save(tmp_path / "objects.npy", np.array([{}], dtype=object), allow_pickle=True)
    assert "it holds Python objects" in refused("localize", DEMO_FILE, tmp_path / "objects.npy", "--start", start)
    np.save(tmp_path / "bytes.npy", np.full((64, 64), 200.0))
    told = refused("localize", DEMO_FILE, tmp_path / "bytes.npy", "--start", start)
    assert "in [0, 1], or uint8, got float64 from 200 to 200" in told

"""`ultragray export` and `ultragray import`: files of other programs, and back."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ultragray import GaussianScene, LinearProbe

from .command_line import run


@pytest.fixture
def make_file(tmp_path: Path, random_scene: Callable[..., GaussianScene], random_poses: Callable[..., Any]) -> Any:
    def make(**options: Any) -> Path:
        info = {"probe": LinearProbe(30.0, 0.0, 40.0), "image_height": 24, "image_width": 20}
        made = random_scene(60, info=info, **options)
        path = tmp_path / "scene.ugr"
        GaussianScene.from_splats(made.splats, info=made.info, training_poses=random_poses(5)).save(path)
        return path

    return make


def test_a_ply_and_back_is_the_same_file(make_file: Callable[..., Path], tmp_path: Path) -> None:
    scene = make_file(intensity="sigmoid")
    result = run("export", scene, "-o", tmp_path / "a.ply")
    assert (result.exit_code, result.stderr) == (0, "")
    assert "60 Gaussians, 5 training poses" in result.stdout
    assert run("import", tmp_path / "a.ply", "-o", tmp_path / "b.ugr").exit_code == 0
    assert (tmp_path / "b.ugr").read_bytes() == scene.read_bytes()


def test_a_checkpoint_and_back_by_the_documented_commands(make_file: Callable[..., Path], tmp_path: Path) -> None:
    folder = tmp_path / "released"
    result = run("export", make_file(), "-o", folder / "ckpt_0.pt")
    assert (result.exit_code, result.stderr) == (0, "")
    assert all(str(folder / name) in result.stdout for name in ("ckpt_0.pt", "conf.json", "poses_train.npy"))
    back = run(
        *("import", folder / "ckpt_0.pt", "--config", folder / "conf.json"),
        *("--poses", folder / "poses_train.npy", "-o", tmp_path / "back.ugr"),
    )
    assert back.exit_code == 0, back.output
    assert "60 Gaussians" in back.stdout


def test_what_the_released_format_cannot_hold_is_noted(make_file: Callable[..., Path], tmp_path: Path) -> None:
    result = run("export", make_file(intensity="sigmoid"), "-o", tmp_path / "out" / "ckpt.pt")
    assert result.exit_code == 0
    assert result.stderr.startswith("note: its intensities are `sigmoid`")

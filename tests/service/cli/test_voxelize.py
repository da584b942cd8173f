"""`ultragray voxelize`: a scene file in, a volume or a slice out."""

from __future__ import annotations

import json
from pathlib import Path

import nibabel
import numpy as np
import pytest

from .command_line import run


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("demo") / "demo.ugr"
    assert run("demo", "-o", path).exit_code == 0
    return path


def test_a_scene_becomes_a_volume_over_its_bounds(demo: Path, tmp_path: Path) -> None:
    result = run("voxelize", demo, "-o", tmp_path / "v.nii.gz", "--spacing-mm", 3, "--field", "labels", "--json")
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    image = nibabel.load(tmp_path / "v.nii.gz")
    assert list(image.shape) == document["shape"]
    np.testing.assert_allclose(image.affine, document["affine"], atol=1e-4)
    present = {str(label) for label in np.unique(np.asarray(image.dataobj)) if label}
    assert present
    assert present <= set(document["label_names"])


def test_a_slice_through_a_plane(demo: Path, tmp_path: Path) -> None:
    plane = ("--plane-mm=-20,0,5", "--right", "1,0,0", "--down", "0,0.2,1", "--size-mm", "40,30", "--spacing-mm", 1)
    result = run("voxelize", demo, "-o", tmp_path / "s.npy", *plane)
    assert result.exit_code == 0, result.output
    assert "echo, 40 x 30 x 1 at 1 mm" in result.stdout
    assert np.load(tmp_path / "s.npy").shape == (30, 40)


def test_a_box_beyond_the_scene_is_warned_of(demo: Path, tmp_path: Path) -> None:
    box = ("--box-mm", "5000:5010,0:10,0:10", "--spacing-mm", 5)
    result = run("voxelize", demo, "-o", tmp_path / "v.nii", *box)
    assert result.exit_code == 0, result.output
    assert "box_mm lies beyond all Gaussians, which are in -" in result.stderr
    assert "warning" not in run("voxelize", demo, "-o", tmp_path / "w.nii", "--spacing-mm", 8).stderr

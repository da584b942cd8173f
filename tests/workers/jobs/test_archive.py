from __future__ import annotations

import json
import tarfile
from pathlib import Path

import cv2
import numpy as np

from ultragray_workers.jobs.archive import ArchiveHeader, NpzArchive, TarArchive

HEADER = ArchiveHeader(
    outputs=("bmode", "echo"),
    poses=np.tile(np.eye(4), (5, 1, 1)),
    height=3,
    width=4,
    scene="one",
    scene_sha256="0" * 64,
    renderer="ultragray",
)
FRAMES = {name: np.random.default_rng(seed).random((5, 3, 4), np.float32) for seed, name in enumerate(HEADER.outputs)}


def fill(archive: NpzArchive | TarArchive) -> None:
    for places in (slice(0, 2), slice(2, 4), slice(4, 5)):
        archive.add({name: frames[places] for name, frames in FRAMES.items()})
    archive.close()


def test_npz_holds_all_frames_and_leaves_nothing_beside(tmp_path: Path) -> None:
    fill(NpzArchive(tmp_path / "frames.npz", HEADER))
    with np.load(tmp_path / "frames.npz") as archive:
        for name, frames in FRAMES.items():
            np.testing.assert_array_equal(archive[name], frames)
        np.testing.assert_array_equal(archive["poses"], HEADER.poses)
        assert str(archive["scene"]) == "one"
    assert [path.name for path in tmp_path.iterdir()] == ["frames.npz"]


def test_tar_is_a_webdataset(tmp_path: Path) -> None:
    fill(TarArchive(tmp_path / "frames.tar", HEADER))
    with tarfile.open(tmp_path / "frames.tar") as tar:
        parts = ("bmode.png", "echo.png", "json")
        assert tar.getnames() == [f"{number:06d}.{part}" for number in range(5) for part in parts]
        for name, frames in FRAMES.items():
            file = tar.extractfile(f"000004.{name}.png")
            assert file is not None
            pixels = cv2.imdecode(np.frombuffer(file.read(), np.uint8), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(pixels, np.rint(frames[4] * 255))
        file = tar.extractfile("000002.json")
        assert file is not None
        assert json.load(file)["pose"] == np.eye(4).tolist()

"""The demo scene: the file that is shipped is as good as it says, and shows the anatomy that it was trained from."""

from __future__ import annotations

import logging
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import torch

from ultragray import GaussianScene, LinearProbe, read_header, render
from ultragray.datasets import Dataset, Sweep
from ultragray.errors import InvalidArgument
from ultragray.learn.evaluation.scoring import evaluate, render_sweep
from ultragray.learn.sweep import pixel_positions_mm
from ultragray.learn.training import TrainingConfig
from ultragray.phantom import Tissue, load_phantom, simulate, sweeps, tissue_at
from ultragray.phantom.demo import DEMO_FILE, DEMO_IMAGE_SIDE, DEMO_PROBE, copy_demo_scene, demo_poses, load_demo_scene

from ..scripts import benchmark

make = benchmark("demo_scene")
BoneShadow = benchmark("bone_shadow").BoneShadow
SIDE = 256
MM_PER_PIXEL = 60.0 / SIDE
MAX_BYTES = 4_500_000
VIEWS = ("bmode", "transmittance")

Image = npt.NDArray[np.float32]


@pytest.fixture(scope="module")
def scene() -> GaussianScene:
    return load_demo_scene()


@pytest.fixture(scope="module")
def truth() -> dict[str, npt.NDArray[np.bool_]]:
    """Where the phantom's tissues lie in the image at the identity, [SIDE, SIDE] each."""
    positions = pixel_positions_mm(DEMO_PROBE, SIDE, SIDE)
    tissue = tissue_at(positions).reshape(SIDE, SIDE)
    by_name = {"bone": Tissue.BONE, "muscle": Tissue.MUSCLE, "fat": Tissue.FAT, "vessel": Tissue.BLOOD}
    return {name: tissue == value for name, value in by_name.items()}


@pytest.fixture(scope="module")
def phantom() -> Dataset:
    """The phantom's dataset with the right poses and noise for frames, which would take half a minute."""

    def noise(poses: npt.NDArray[np.float64], *, height: int, width: int, probe: LinearProbe) -> npt.NDArray[np.uint8]:
        return np.random.default_rng(0).integers(0, 256, (len(poses), height, width), dtype=np.uint8)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweeps, "simulate", noise)
        return load_phantom()


@pytest.fixture(scope="module")
def held_out(phantom: Dataset) -> Sweep:
    """The phantom's held-out sweep as it is."""
    sweep = phantom.val
    images = simulate(sweep.poses, probe=DEMO_PROBE, height=sweep.height, width=sweep.width)
    return replace(sweep, images=images)


@pytest.fixture(scope="module")
def transverse(scene: GaussianScene) -> dict[str, Image]:
    """The view of a probe at the origin."""
    return view(scene, np.eye(4))


def view(scene: GaussianScene, pose: npt.NDArray[np.float64]) -> dict[str, Image]:
    frames = render(scene, None, pose, height=SIDE, width=SIDE, outputs=VIEWS)
    return {name: getattr(frames, name)[0].numpy() for name in VIEWS}


def patch(image: Image, x_mm: tuple[float, float], z_mm: tuple[float, float]) -> Image:
    """The pixels between two lateral positions and two depths."""
    left, right = (round((x + 30.0) / MM_PER_PIXEL) for x in x_mm)
    top, bottom = (round(z / MM_PER_PIXEL) for z in z_mm)
    return image[top:bottom, left:right]


# The file


def test_the_file_is_small_and_describes_itself(phantom: Dataset) -> None:
    header = read_header(DEMO_FILE)
    assert header.file_bytes < MAX_BYTES
    info = header.info
    assert info.dataset_name == "demo lumbar spine (in silico)"
    assert (info.probe, info.image_height, info.image_width) == (DEMO_PROBE, DEMO_IMAGE_SIDE, DEMO_IMAGE_SIDE)
    assert 10_000 < info.gaussian_count <= make.MAX_GAUSSIANS
    assert info.training["step"] == info.training["steps"]
    np.testing.assert_allclose(info.centre_mm, phantom.centre_mm, atol=1e-6)
    np.testing.assert_allclose(header.training_poses, phantom.train.poses, atol=1e-12)


def test_copying_it_needs_no_torch(tmp_path: Path) -> None:
    program = (
        "import sys; from ultragray.phantom.demo import copy_demo_scene; copy_demo_scene(sys.argv[1]); "
        "print('torch' in sys.modules)"
    )
    copy = tmp_path / "copy.ugr"
    command = [sys.executable, "-c", program, str(copy)]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip() == "False"
    assert copy.read_bytes() == DEMO_FILE.read_bytes()
    with pytest.raises(FileNotFoundError):
        copy_demo_scene(tmp_path / "absent" / "copy.ugr")


# Its figures


@pytest.mark.long
def test_its_figures_are_good_and_those_of_the_held_out_sweep(scene: GaussianScene, held_out: Sweep) -> None:
    stored = scene.info.metrics
    assert stored["psnr_db"] > 21.0
    assert stored["ms_ssim"] > 0.85
    assert stored["shadow_mae"] < 0.012
    assert stored["shadow_transmittance"] < 0.15
    shadow = BoneShadow.of(held_out)
    measured = {
        **evaluate(scene, held_out).mean.to_dict(),
        "shadow_mae": shadow.mean_absolute_error(render_sweep(scene, held_out)),
        "shadow_transmittance": shadow.mean(render_sweep(scene, held_out, output="transmittance")),
    }
    assert stored == pytest.approx(measured, rel=1e-3)


# What it shows


@pytest.mark.parametrize("x_mm", [(-11.0, -5.0), (-1.5, 1.5), (5.0, 11.0)])
def test_bone_is_bright_and_casts_a_shadow(transverse: dict[str, Image], x_mm: tuple[float, float]) -> None:
    bone_depths = (11.0, 17.0) if x_mm[0] < 0.0 < x_mm[1] else (28.0, 36.0)
    assert np.median(patch(transverse["bmode"], x_mm, bone_depths).max(axis=0)) > 0.6
    assert patch(transverse["transmittance"], x_mm, (45.0, 59.0)).mean() < 0.15
    assert patch(transverse["bmode"], x_mm, (45.0, 59.0)).mean() < 0.02


def test_beside_the_shadow_tissue_is_seen_down_to_the_last_row(transverse: dict[str, Image]) -> None:
    for x_mm in ((-28.0, -21.0), (22.0, 28.0)):
        assert patch(transverse["transmittance"], x_mm, (54.0, 59.0)).mean() > 0.3
        assert patch(transverse["bmode"], x_mm, (54.0, 59.0)).mean() > 0.15


def test_the_vessel_is_empty_within_its_wall(transverse: dict[str, Image]) -> None:
    muscle = patch(transverse["bmode"], (-28.0, -18.0), (15.0, 35.0)).mean()
    middle = patch(transverse["bmode"], (18.9, 20.9), (22.2, 24.2))
    assert middle.mean() < 0.25 * muscle
    assert patch(transverse["bmode"], (17.0, 23.0), (19.5, 22.0)).max() > 1.2 * muscle


def test_fascia_stands_out_from_fat_and_muscle(transverse: dict[str, Image]) -> None:
    for x_mm in ((-25.0, -10.0), (10.0, 25.0)):
        fascia = patch(transverse["bmode"], x_mm, (7.5, 12.0)).max(axis=0)
        fat = patch(transverse["bmode"], x_mm, (2.5, 7.0))
        muscle = patch(transverse["bmode"], x_mm, (12.5, 20.0))
        assert np.median(fascia) > 1.5 * max(fat.mean(), muscle.mean())


def test_between_two_vertebrae_the_beam_reaches_the_canal(scene: GaussianScene) -> None:
    gap = np.eye(4)
    gap[1, 3] = 19.0
    frame = view(scene, gap)
    middle = (-4.0, 4.0)
    assert patch(frame["transmittance"], middle, (50.0, 53.0)).mean() > 0.3
    canal = patch(frame["bmode"], middle, (44.0, 50.0)).mean()
    assert canal < 0.35 * patch(frame["bmode"], middle, (15.0, 32.0)).mean()
    assert np.median(patch(frame["bmode"], middle, (51.0, 58.0)).max(axis=0)) > 0.5


def test_paramedian_sagittal_view_shows_the_saw_tooth_of_laminae(scene: GaussianScene) -> None:
    frame = view(scene, make.picture_views()["sagittal"][1])
    cranial, caudal = (patch(frame["bmode"], x, (24.0, 45.0)) for x in ((-7.0, -5.0), (7.0, 9.0)))
    depth = [24.0 + np.median(part.argmax(axis=0)) * MM_PER_PIXEL for part in (cranial, caudal)]
    assert depth[0] - depth[1] > 2.5  # the lamina rises towards its caudal edge
    shadowed = patch(frame["bmode"], (-29.0, 29.0), (46.0, 53.0)).mean(axis=0) < 0.05
    assert 0.4 < shadowed.mean() < 0.95  # shadows, and gaps between them


def test_demo_poses_follow_the_spine() -> None:
    assert [demo_poses(count).shape for count in (0, 1, 8)] == [(0, 4, 4), (1, 4, 4), (8, 4, 4)]
    poses = demo_poses(121)
    np.testing.assert_allclose(poses[60], np.eye(4), atol=1e-12)
    assert (poses[0, 1, 3], poses[-1, 1, 3]) == (pytest.approx(-36.0), pytest.approx(36.0))
    with pytest.raises(InvalidArgument, match="count"):
        demo_poses(-1)


# How it is made


def test_making_a_small_one(
    phantom: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    few = Dataset("phantom", train=small(phantom.train.select([40, 45, 50])), val=small(phantom.val.select([12])))
    config = TrainingConfig.preset("fast", max_gaussians=60, steps=4)
    monkeypatch.setattr(make, "load_phantom", lambda: few)
    monkeypatch.setattr(TrainingConfig, "preset", lambda name, max_gaussians: config)
    monkeypatch.setattr(make, "DEMO_FILE", tmp_path / "spine.ugr")
    monkeypatch.setattr(make, "PICTURES_FOLDER", tmp_path)
    with caplog.at_level(logging.INFO):
        make.main()
    made = GaussianScene.load(tmp_path / "spine.ugr")
    assert made.info.dataset_name == "demo lumbar spine (in silico)"
    assert made.info.dataset_sha256 == few.sha256
    shadow = BoneShadow.of(few.val)
    assert made.info.metrics == pytest.approx(
        {
            **evaluate(made, few.val).mean.to_dict(),
            "shadow_mae": shadow.mean_absolute_error(render_sweep(made, few.val)),
            "shadow_transmittance": shadow.mean(render_sweep(made, few.val, output="transmittance")),
        },
        rel=1e-4,
    )
    for view in make.picture_views():
        assert max(cv2.imread(str(tmp_path / f"demo_{view}.png"), cv2.IMREAD_UNCHANGED).shape) in (511, 512)
    assert "shadow_transmittance" in caplog.text


def small(sweep: Sweep) -> Sweep:
    """The sweep in images of 32x32 pixels."""
    step = math.ceil(sweep.height / 32)
    return replace(sweep, images=np.ascontiguousarray(sweep.images[:, ::step, ::step]))


def test_every_gaussian_carries_the_tissue_at_its_mean(scene: GaussianScene) -> None:
    assert scene.info.label_names == {1: "bone", 2: "muscle", 3: "fat", 4: "vessel"}
    assert scene.labels is not None
    tissue = tissue_at(np.asarray(scene.info.centre_mm) + 10.0 * scene.means.double().numpy())
    labels = scene.labels.numpy()
    for label, value in ((1, Tissue.BONE), (2, Tissue.MUSCLE), (3, Tissue.FAT), (4, Tissue.BLOOD)):
        np.testing.assert_array_equal(labels == label, tissue == value)
        assert (labels == label).sum() > 200
    assert torch.equal(make.labelled(replace(scene, labels=None)).labels, scene.labels)


def test_labels_show_the_anatomy(scene: GaussianScene, truth: dict[str, npt.NDArray[np.bool_]]) -> None:
    labels = render(scene, None, np.eye(4), height=SIDE, width=SIDE, outputs=("labels",)).labels
    assert labels is not None
    found = labels[0].numpy()
    lit = np.s_[: int(30 / MM_PER_PIXEL)]  # above the shadow of bone
    for label, name in scene.info.label_names.items():
        shown, there = found[lit] == label, truth[name][lit]
        overlap = (shown & there).sum() / (shown | there).sum()
        assert overlap > (0.3 if name == "vessel" else 0.65), (name, overlap)

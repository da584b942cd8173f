"""The demo scene: the file that is shipped is as good as it says, and shows the anatomy that it was trained from."""

import logging
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from ultragray import GaussianScene, read_header, render
from ultragray.datasets import Dataset
from ultragray.errors import InvalidArgument
from ultragray.learn.evaluation.scoring import evaluate, render_sweep
from ultragray.learn.training import TrainingConfig
from ultragray.phantom import Tissue, load_phantom, simulate, sweeps, tissue_at
from ultragray.phantom.demo import DEMO_FILE, DEMO_IMAGE_SIDE, DEMO_PROBE, demo_poses, load_demo_scene

from ..scripts import benchmark

make = benchmark("demo_scene")
BoneShadow = benchmark("bone_shadow").BoneShadow
SIDE = 256
MM_PER_PIXEL = 60.0 / SIDE
MAX_BYTES = 4_500_000
VIEWS = ("bmode", "transmittance")


@pytest.fixture(scope="module")
def scene():
    return load_demo_scene()


@pytest.fixture(scope="module")
def phantom():
    """The phantom's dataset with the right poses and noise for frames, which would take half a minute."""

    def noise(poses, *, height, width, probe):
        return np.random.default_rng(0).integers(0, 256, (len(poses), height, width), dtype=np.uint8)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweeps, "simulate", noise)
        return load_phantom()


@pytest.fixture(scope="module")
def held_out(phantom):
    """The phantom's held-out sweep as it is."""
    sweep = phantom.val
    images = simulate(sweep.poses, probe=DEMO_PROBE, height=sweep.height, width=sweep.width)
    return replace(sweep, images=images)


@pytest.fixture(scope="module")
def transverse(scene):
    """The view of a probe at the origin."""
    return view(scene, np.eye(4))


def view(scene, pose):
    frames = render(scene, None, pose, height=SIDE, width=SIDE, outputs=VIEWS)
    return {name: getattr(frames, name)[0].numpy() for name in VIEWS}


def patch(image, x_mm, z_mm):
    """The pixels between two lateral positions and two depths."""
    left, right = (round((x + 30.0) / MM_PER_PIXEL) for x in x_mm)
    top, bottom = (round(z / MM_PER_PIXEL) for z in z_mm)
    return image[top:bottom, left:right]


# The file


def test_the_file_is_small_and_describes_itself(phantom):
    header = read_header(DEMO_FILE)
    assert header.file_bytes < MAX_BYTES
    info = header.info
    assert info.dataset_name == "demo lumbar spine (in silico)"
    assert (info.probe, info.image_height, info.image_width) == (DEMO_PROBE, DEMO_IMAGE_SIDE, DEMO_IMAGE_SIDE)
    assert 10_000 < info.gaussian_count <= make.MAX_GAUSSIANS
    assert info.training["step"] == info.training["steps"]
    np.testing.assert_allclose(info.centre_mm, phantom.centre_mm, atol=1e-6)
    np.testing.assert_allclose(header.training_poses, phantom.train.poses, atol=1e-12)


# Its figures


@pytest.mark.long
def test_its_figures_are_good_and_those_of_the_held_out_sweep(scene, held_out):
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
def test_bone_is_bright_and_casts_a_shadow(transverse, x_mm):
    bone_depths = (11.0, 17.0) if x_mm[0] < 0.0 < x_mm[1] else (28.0, 36.0)
    assert np.median(patch(transverse["bmode"], x_mm, bone_depths).max(axis=0)) > 0.6
    assert patch(transverse["transmittance"], x_mm, (45.0, 59.0)).mean() < 0.15
    assert patch(transverse["bmode"], x_mm, (45.0, 59.0)).mean() < 0.02


def test_demo_poses_follow_the_spine():
    assert [demo_poses(count).shape for count in (0, 1, 8)] == [(0, 4, 4), (1, 4, 4), (8, 4, 4)]
    poses = demo_poses(121)
    np.testing.assert_allclose(poses[60], np.eye(4), atol=1e-12)
    assert (poses[0, 1, 3], poses[-1, 1, 3]) == (pytest.approx(-36.0), pytest.approx(36.0))
    with pytest.raises(InvalidArgument, match="count"):
        demo_poses(-1)


# How it is made


def test_making_a_small_one(phantom, tmp_path, monkeypatch, caplog):
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


def small(sweep):
    """The sweep in images of 32x32 pixels."""
    step = math.ceil(sweep.height / 32)
    return replace(sweep, images=np.ascontiguousarray(sweep.images[:, ::step, ::step]))


def test_every_gaussian_carries_the_tissue_at_its_mean(scene):
    assert scene.info.label_names == {1: "bone", 2: "muscle", 3: "fat", 4: "vessel"}
    tissue = tissue_at(np.asarray(scene.info.centre_mm) + 10.0 * scene.means.double().numpy())
    labels = scene.labels.numpy()
    for label, value in ((1, Tissue.BONE), (2, Tissue.MUSCLE), (3, Tissue.FAT), (4, Tissue.BLOOD)):
        np.testing.assert_array_equal(labels == label, tissue == value)
        assert (labels == label).sum() > 200
    assert torch.equal(make.labelled(replace(scene, labels=None)).labels, scene.labels)

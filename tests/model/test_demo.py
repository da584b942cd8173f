"""The demo scene: the same every time, valid, and with the physics that its anatomy promises."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import torch

from ultragray import GaussianScene, check_poses, read_header, render
from ultragray.demo import CENTRE_MM, DEMO_PROBE, build_demo_scene, demo_poses
from ultragray.errors import InvalidArgument
from ultragray.pose import rotation_angles_deg

SIDE = 256
MM_PER_PIXEL = 60.0 / SIDE

Image = npt.NDArray[np.float32]


@pytest.fixture(scope="module")
def scene() -> GaussianScene:
    return build_demo_scene()


@pytest.fixture(scope="module")
def transverse(scene: GaussianScene) -> dict[str, Image]:
    """The view of a probe at the origin."""
    return view(scene, np.eye(4))


def view(scene: GaussianScene, pose: npt.NDArray[np.float64]) -> dict[str, Image]:
    frames = render(scene, None, pose, height=SIDE, width=SIDE)
    return {name: getattr(frames, name)[0].numpy() for name in ("bmode", "echo", "transmittance")}


def patch(image: Image, x_mm: tuple[float, float], z_mm: tuple[float, float]) -> Image:
    """The pixels between two lateral positions and two depths."""
    left, right = (round((x + 30.0) / MM_PER_PIXEL) for x in x_mm)
    top, bottom = (round(z / MM_PER_PIXEL) for z in z_mm)
    return image[top:bottom, left:right]


def test_the_scene_is_bit_identical_on_every_call(scene: GaussianScene) -> None:
    np.random.seed(7)  # global generators must not matter
    torch.manual_seed(7)
    assert build_demo_scene().to_bytes() == scene.to_bytes()


def test_size_degree_and_description(scene: GaussianScene) -> None:
    assert 60_000 <= scene.gaussian_count <= 150_000
    assert len(scene.to_bytes()) < 10_000_000
    assert scene.sh_degree == 1
    info = scene.info
    assert (info.probe, info.image_height, info.image_width) == (DEMO_PROBE, 512, 512)
    assert (info.intensity, info.centre_mm) == ("sigmoid", CENTRE_MM)
    assert info.bounds_min_mm[2] > -1.0
    assert info.bounds_max_mm[2] < 65.0
    for axis, half in ((0, 37.0), (1, 50.0)):
        assert -half < info.bounds_min_mm[axis] < -30.0
        assert 30.0 < info.bounds_max_mm[axis] < half


def test_transmittance_tells_bone_from_soft_tissue(scene: GaussianScene) -> None:
    tau = torch.sigmoid(scene.transmittances)
    assert float(tau.min()) > 0.0
    assert float(tau.max()) < 1.0
    absorbing = (tau < 0.05).float().mean()
    assert 0.02 < float(absorbing) < 0.3
    assert float((tau > 0.95).float().mean()) > 0.6


def test_the_scene_survives_its_file(scene: GaussianScene, tmp_path: Path) -> None:
    path = tmp_path / "demo.ugr"
    scene.save(path)
    loaded = GaussianScene.load(path)
    assert all(torch.equal(loaded.splats[name], tensor) for name, tensor in scene.splats.items())
    np.testing.assert_allclose(loaded.training_poses, scene.training_poses, atol=1e-12)
    assert read_header(path).info == scene.info


def test_training_poses_are_a_tilted_sweep_along_the_spine(scene: GaussianScene) -> None:
    poses = scene.training_poses
    np.testing.assert_allclose(check_poses(poses), poses, atol=1e-12)
    assert np.all(np.diff(poses[:, 1, 3]) > 0.0)
    assert poses[0, 1, 3] == pytest.approx(-36.0)
    assert poses[-1, 1, 3] == pytest.approx(36.0)
    angles = rotation_angles_deg(poses, np.eye(4)[None])
    assert 2.0 < angles.max() < 10.0
    np.testing.assert_allclose(poses[len(poses) // 2], np.eye(4), atol=1e-12)


def test_demo_poses_of_any_count() -> None:
    assert [demo_poses(count).shape for count in (0, 1, 8)] == [(0, 4, 4), (1, 4, 4), (8, 4, 4)]
    np.testing.assert_array_equal(demo_poses(1)[0], np.eye(4))
    with pytest.raises(InvalidArgument, match="count"):
        demo_poses(-1)


@pytest.mark.parametrize("x_mm", [(-11.0, -5.0), (-1.5, 1.5), (5.0, 11.0)])
def test_bone_is_bright_and_casts_a_shadow(transverse: dict[str, Image], x_mm: tuple[float, float]) -> None:
    bone_depths = (11.0, 17.0) if x_mm[0] < 0.0 < x_mm[1] else (28.0, 36.0)
    assert np.median(patch(transverse["bmode"], x_mm, bone_depths).max(axis=0)) > 0.6
    assert patch(transverse["transmittance"], x_mm, (45.0, 59.0)).mean() < 0.05
    assert patch(transverse["bmode"], x_mm, (45.0, 59.0)).max() < 0.05


def test_beside_the_shadow_tissue_is_seen_down_to_the_last_row(transverse: dict[str, Image]) -> None:
    for x_mm in ((-28.0, -21.0), (22.0, 28.0)):
        deep = patch(transverse["transmittance"], x_mm, (54.0, 59.0))
        assert 0.4 < deep.mean() < 0.9
        assert patch(transverse["bmode"], x_mm, (54.0, 59.0)).mean() > 0.1


def test_the_vessel_is_empty_within_a_bright_wall(transverse: dict[str, Image]) -> None:
    rows = slice(round(20.0 / MM_PER_PIXEL), round(27.0 / MM_PER_PIXEL))
    columns = slice(round(46.0 / MM_PER_PIXEL), round(55.0 / MM_PER_PIXEL))
    around = transverse["bmode"][rows, columns]
    kernel = 9  # about 2 mm
    windows = np.lib.stride_tricks.sliding_window_view(around, (kernel, kernel)).mean(axis=(2, 3))
    muscle = patch(transverse["bmode"], (-28.0, -18.0), (15.0, 35.0)).mean()
    assert windows.min() < 0.25 * muscle
    assert around.max() > 2.0 * muscle


def test_fascia_stands_out_from_fat_and_muscle(transverse: dict[str, Image]) -> None:
    for x_mm in ((-25.0, -10.0), (10.0, 25.0)):
        fascia = patch(transverse["bmode"], x_mm, (7.5, 12.0)).max(axis=0)
        fat = patch(transverse["bmode"], x_mm, (2.5, 7.0))
        muscle = patch(transverse["bmode"], x_mm, (12.5, 20.0))
        assert np.median(fascia) > 2.0 * max(fat.mean(), muscle.mean())
        assert fat.mean() < 0.45


def test_between_two_vertebrae_the_beam_reaches_the_canal(scene: GaussianScene) -> None:
    gap = np.eye(4)
    gap[1, 3] = 19.0
    frame = view(scene, gap)
    middle = (-4.0, 4.0)
    assert patch(frame["transmittance"], middle, (50.0, 59.0)).mean() > 0.4
    canal = patch(frame["bmode"], middle, (44.0, 50.0)).mean()
    assert canal < 0.35 * patch(frame["bmode"], middle, (15.0, 32.0)).mean()
    assert np.median(patch(frame["bmode"], middle, (51.0, 58.0)).max(axis=0)) > 0.4


def test_paramedian_sagittal_view_shows_the_saw_tooth_of_laminae(scene: GaussianScene) -> None:
    sagittal = np.eye(4)
    sagittal[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    sagittal[0, 3] = 12.0
    frame = view(scene, sagittal)
    cranial, caudal = (patch(frame["bmode"], x, (24.0, 45.0)) for x in ((-7.0, -5.0), (7.0, 9.0)))
    depth = [24.0 + np.median(part.argmax(axis=0)) * MM_PER_PIXEL for part in (cranial, caudal)]
    assert depth[0] - depth[1] > 2.5  # the lamina rises towards its caudal edge
    shadowed = patch(frame["transmittance"], (-29.0, 29.0), (56.0, 59.0)).mean(axis=0) < 0.05
    assert 0.4 < shadowed.mean() < 0.95  # shadows, and gaps between them


def test_the_echo_of_bone_depends_on_the_angle_it_is_seen_from(scene: GaussianScene) -> None:
    """The spinous process from above and from far to the side: the same place, another brightness."""
    from_above, from_aside = np.eye(4), np.eye(4)
    from_aside[0, 3] = 27.0
    above = patch(view(scene, from_above)["echo"], (-1.5, 1.5), (13.0, 15.5)).max()
    aside = patch(view(scene, from_aside)["echo"], (-28.5, -25.5), (13.0, 15.5)).max()
    assert aside < 0.92 * above

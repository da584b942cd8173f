"""The phantom's tissue map: what the anatomy promises lies where it should, and shapes are honest distances."""

import numpy as np
import pytest

from ultragray.errors import InvalidArgument
from ultragray.phantom import Tissue, anatomy, tissue_at
from ultragray.phantom import anatomy as bone
from ultragray.phantom.anatomy import INTERFACES, LatticeNoise


@pytest.mark.parametrize(
    ("tissue", "point_mm"),
    [
        (Tissue.OUTSIDE, (0.0, 0.0, -0.5)),
        (Tissue.SKIN, (5.0, 0.0, 1.0)),
        (Tissue.FAT, (14.0, 0.0, 5.0)),
        (Tissue.MUSCLE, (-14.0, 0.0, 22.0)),
        (Tissue.BONE, (0.0, 4.0, 20.0)),  # spinous process
        (Tissue.BONE, (9.0, 2.0, 35.0)),  # lamina
        (Tissue.LIGAMENT, (0.0, 18.0, 25.0)),  # between two spinous processes
        (Tissue.BLOOD, (21.0, 0.0, 23.0)),
        (Tissue.FLUID, (0.0, 18.0, 47.0)),  # dural sac
        (Tissue.FAT, (0.0, 18.0, 39.5)),  # epidural
        (Tissue.DISC, (0.0, 17.5, 60.0)),
        (Tissue.BONE, (0.0, 0.0, 60.0)),  # vertebral body
    ],
)
def test_tissue_at_landmarks(tissue, point_mm):
    assert tissue_at(np.array([point_mm]))[0] == tissue


def test_fascia_is_a_thin_layer_between_fat_and_muscle():
    depth = np.arange(5.0, 15.0, 0.02)
    line = np.stack([np.full_like(depth, 14.0), np.zeros_like(depth), depth], axis=1)
    labels = tissue_at(line)
    assert list(dict.fromkeys(labels.tolist())) == [Tissue.FAT, Tissue.FASCIA, Tissue.MUSCLE]
    assert 0.7 < 0.02 * (labels == Tissue.FASCIA).sum() < 1.4


def test_tissue_at_keeps_to_uint8_and_refuses_other_shapes():
    assert tissue_at(np.zeros((0, 3))).dtype == np.uint8
    for shape in ((3,), (2, 4), (1, 2, 3)):
        with pytest.raises(InvalidArgument, match="points_mm must be"):
            tissue_at(np.zeros(shape))


def test_the_skin_is_flat_under_the_probe():
    points = np.random.default_rng(0).uniform((-30, -40, 0), (30, 40, 0), (200, 3))
    np.testing.assert_array_equal(anatomy.straightened(points), points)


def test_bone_distance_never_promises_more_than_there_is():
    rng = np.random.default_rng(2)
    points = rng.uniform((-30, -15, 10), (30, 15, 65), (4000, 3))
    steps = rng.normal(size=points.shape)
    steps *= 0.01 / np.linalg.norm(steps, axis=1, keepdims=True)
    slope = np.abs(bone.distance_mm(points + steps) - bone.distance_mm(points)) / 0.01
    assert slope.max() < 1.15
    assert (slope > 0.5).mean() > 0.3


def test_every_interface_is_met_somewhere_and_carries_a_sign_change():
    points = np.random.default_rng(3).uniform((-30, -18, 0), (30, 18, 62), (60_000, 3)).astype(np.float32)
    drawn = anatomy.straightened(points)
    for interface in INTERFACES:
        low, high = interface.depths_mm
        inside = (points[:, 2] > low) & (points[:, 2] < high)
        here = drawn[inside]
        here = here[interface.present(here)]
        level = interface.level(here)
        assert 0.0 < (level < 0.0).mean() < 1.0
        assert (np.abs(level) < 0.4).sum() > 20


def test_noise_is_smooth_seeded_and_of_its_own_scale():
    noise = LatticeNoise(5, (2.0, 10.0, 1.0))
    points = np.random.default_rng(4).uniform(-50, 50, (20_000, 3))
    values = noise(points)
    assert np.abs(values).max() <= 1.0
    assert values.std() > 0.2
    np.testing.assert_array_equal(LatticeNoise(5, (2.0, 10.0, 1.0))(points), values)
    assert np.abs(np.corrcoef(LatticeNoise(6, (2.0, 10.0, 1.0))(points), values)[0, 1]) < 0.1
    change = [np.abs(noise(points + 0.01 * axis) - values).max() / 0.01 for axis in np.eye(3)]
    assert change[1] < 0.4  # at most 3 per cell: 2 (the range) × 1.5 (the smoothest step)
    assert change[0] < 1.6
    assert change[1] < change[0] < change[2] < 3.1

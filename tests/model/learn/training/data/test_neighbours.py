"""The neighbours of frames, across gaps, and the ends of sweeps."""

from dataclasses import replace

import numpy as np
import pytest

from ultragray.learn.training.between import neighbours_of


def moved(sweep, y_mm, *, x_mm=None):
    poses = np.tile(sweep.poses[0], (len(y_mm), 1, 1))
    poses[:, 1, 3] += y_mm
    poses[:, 0, 3] += x_mm or 0.0
    images = np.resize(sweep.images, (len(y_mm), *sweep.images.shape[1:]))
    return replace(sweep, images=images, poses=poses, frame_numbers=np.arange(len(y_mm)))


def test_neighbours_are_the_nearest_on_either_side_whatever_the_order(tiny_dataset):
    neighbours = neighbours_of(moved(tiny_dataset().train, [0.0, 2.0, 1.0, 9.0]))
    found = {tuple(pair): gap for pair, gap in zip(neighbours.pairs.tolist(), neighbours.gaps_mm, strict=True)}
    assert found == {(0, 2): pytest.approx(1.0), (1, 2): pytest.approx(1.0), (1, 3): pytest.approx(7.0)}
    assert neighbours.spacing_mm == pytest.approx(1.0)
    assert list(zip(neighbours.ends.tolist(), neighbours.outward.tolist(), strict=True)) == [(0, -1.0), (3, 1.0)]


def test_a_gap_weighs_as_much_as_it_is_long_and_never_less_than_the_usual_one(tiny_dataset):
    neighbours = neighbours_of(moved(tiny_dataset().train, [0.0, 1.0, 2.0, 2.2, 7.2]))
    weights = neighbours.weights
    assert weights.sum() == pytest.approx(1.0)
    assert (weights[:4] / weights[0]).tolist() == pytest.approx([1.0, 1.0, 1.0, 5.0])
    assert weights[4] / weights[0] == pytest.approx(np.log2(6.25)), "one for each doubling up to a quarter of 25 mm"
    assert neighbours.beyond_mm(np.array([0.0, 1.0])).tolist() == pytest.approx([1.0, 6.25])


def test_a_frame_beside_is_no_neighbour_and_hides_no_end(tiny_dataset):
    sweep = moved(tiny_dataset().train, [0.0, 1.0, 0.5, 1.5], x_mm=[0.0, 0.0, 60.0, 60.0])
    neighbours = neighbours_of(sweep)
    assert neighbours.pairs.tolist() == [[0, 1], [2, 3]]
    assert len(neighbours.ends) == 4


def test_a_probe_held_still_has_no_gaps_but_every_frame_takes_part(tiny_dataset):
    neighbours = neighbours_of(moved(tiny_dataset().train, [0.0, 0.0, 0.0]))
    assert neighbours.spacing_mm == 0.0
    assert neighbours.pairs.tolist() == [[0, 0], [1, 1], [2, 2]]
    assert neighbours.weights[:3].min() > 0.0
    assert len(neighbours.without_ends().ends) == 0


def test_frames_of_a_probe_that_turns_in_place_are_neighbours_by_their_turn(tiny_dataset):
    sweep = moved(tiny_dataset().train, [0.0] * 12)
    poses = sweep.poses.copy()
    angles = np.radians(4.0 * np.arange(12))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(angles)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(angles), -np.sin(angles)
    neighbours = neighbours_of(replace(sweep, poses=poses))
    chain = [[place, place + 1] for place in range(11)]
    assert [pair for pair in neighbours.pairs.tolist() if pair[1] - pair[0] == 1] == chain
    assert len(neighbours.ends) == 0


def test_a_frame_that_only_slides_sideways_is_paired_with_itself(tiny_dataset):
    sweep = moved(tiny_dataset().train, [0.0, 0.1, -0.1], x_mm=[0.0, 8.0, -8.0])
    neighbours = neighbours_of(sweep)
    used = {*neighbours.pairs.flatten().tolist(), *neighbours.ends.tolist()}
    assert used == {0, 1, 2}
    assert neighbours.weights.sum() == pytest.approx(1.0)

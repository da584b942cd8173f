"""Tri-planes: their size, a value by hand, and fits that end where they must."""

import numpy as np
import pytest
import torch

from ultragray_studies.methods.rapidvol import TriPlaneLearner, TriPlanes

from .volumes import along_elevation, one_frame, seen

CPU = torch.device("cpu")
SMALL = seen(along_elevation(np.arange(3.0)), (12, 8))


def new_planes(seed=0):
    return TriPlanes(torch.Generator().manual_seed(seed))


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


def test_the_planes_and_the_decoder_have_so_many_parameters():
    field = new_planes()
    assert field.planes.numel() == 3 * 16 * 128 * 128
    assert count(field.decoder) == (16 * 64 + 64) + (64 * 64 + 64) + (64 + 1)
    assert count(field) == 786_432 + 5_313


def test_a_product_is_that_of_the_three_planes_by_hand():
    field = new_planes()
    node = 2.0 / 127.0  # between two nodes
    with torch.no_grad():
        field.planes.zero_()
        # The point lies at x node 10, a quarter after y node 20, and half after z node 30.
        field.planes[0, 3, 20, 10], field.planes[0, 3, 21, 10] = 2.0, 6.0  # xy: rows are y, columns x
        field.planes[1, 3, 30, 20], field.planes[1, 3, 31, 20] = 1.0, 3.0  # yz: rows are z, columns y
        field.planes[2, 3, 30, 10], field.planes[2, 3, 31, 10] = 10.0, 20.0  # xz: rows are z, columns x
    point = torch.tensor([10.0 * node, 20.25 * node, 30.5 * node]) - 1.0
    found = field.products(point.view(1, 1, 3))[0, 0]
    xy, yz, xz = 0.75 * 2.0 + 0.25 * 6.0, 0.75 * (0.5 * 1.0 + 0.5 * 3.0), 0.5 * 10.0 + 0.5 * 20.0
    assert found[3].item() == pytest.approx(xy * yz * xz, rel=1e-4)
    assert (found[:3] == 0).all()
    assert (found[4:] == 0).all()


def test_beyond_the_box_the_value_at_its_end_goes_on():
    field = new_planes()
    points = torch.tensor([[[1.0, 0.2, -1.0], [1.5, 0.2, -3.0]]])
    torch.testing.assert_close(field(points)[0, 0], field(points)[0, 1])


def test_each_axis_of_the_box_is_scaled_by_its_own_half():
    learner = TriPlaneLearner(SMALL, 0, CPU)
    np.testing.assert_allclose(learner.half_mm, [10.0, 1.0, 12.5])
    points = torch.cat([learner.training_points(place) for place in range(3)]).reshape(-1, 3)
    assert points[:, 1].abs().max().item() == pytest.approx(1.0, abs=1e-5)
    assert points.abs().amax(dim=0).min() > 0.8
    assert points.abs().max() < 1.0 + 1e-5


def test_a_sweep_of_one_plane_has_a_box_all_the_same():
    learner = TriPlaneLearner(one_frame(12, 8), 0, CPU)
    assert learner.half_mm[1] == 1.0
    assert np.isfinite(learner.render(SMALL.probe, SMALL.train.poses, 12, 8)).all()


@pytest.mark.parametrize("seed", range(4))
def test_a_field_begins_above_0_everywhere_without_products_near_0(seed):
    field = new_planes(seed)
    points = 2.0 * torch.rand((40, 40, 3), generator=torch.Generator().manual_seed(seed)) - 1.0
    assert field.products(points).abs().min() > 0.7
    assert (field(points) - 0.5).abs().max() < 0.2


def test_rates_fall_to_1_percent():
    learner = TriPlaneLearner(SMALL, 0, CPU)
    learner.set_rates(0, 100)
    assert [one.param_groups[0]["lr"] for one in learner.optimizers.values()] == [1e-2, 1e-3]
    learner.set_rates(50, 100)
    assert [one.param_groups[0]["lr"] for one in learner.optimizers.values()] == pytest.approx([1e-3, 1e-4])

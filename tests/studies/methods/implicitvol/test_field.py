"""The network of ImplicitVol: its size, its first weights, and what a layer computes."""

from __future__ import annotations

import math

import pytest
import torch

from ultragray_studies.methods.implicitvol import SineField, SineLayer


def new_field(seed: int = 0) -> SineField:
    return SineField(torch.Generator().manual_seed(seed))


def sine_layers(field: SineField) -> list[SineLayer]:
    return [layer for layer in field.modules() if isinstance(layer, SineLayer)]


def test_the_network_has_the_papers_number_of_parameters() -> None:
    assert sum(parameter.numel() for parameter in new_field().parameters()) == 156_673


def test_the_layers_have_the_papers_sizes_and_frequencies() -> None:
    layers = sine_layers(new_field())
    sizes = [(layer.weight.shape[1], layer.weight.shape[0]) for layer in layers]
    assert sizes == [(63, 128), *[(128, 128)] * 3, (191, 128), *[(128, 128)] * 3, (128, 64)]
    assert [layer.frequency for layer in layers] == [30.0, *[1.0] * 8]


def test_weights_fill_the_papers_ranges() -> None:
    field = new_field()
    first, *later = sine_layers(field)
    for layer, bound in [(first, 1 / 63), *((layer, math.sqrt(6 / layer.weight.shape[1])) for layer in later)]:
        assert 0.95 * bound < layer.weight.abs().max() <= bound
        assert 0.8 * bound < layer.bias.abs().max() <= bound
        assert abs(layer.weight.mean()) < 0.05 * bound
    assert field.last.bias.item() == pytest.approx(0.02)


def test_the_first_layer_is_the_sine_of_30_times_its_sum() -> None:
    layer = SineLayer(2, 1, is_first=True)
    layer.load_state_dict({"weight": torch.tensor([[0.1, -0.2]]), "bias": torch.tensor([0.05])})
    found = layer(torch.tensor([0.3, 0.1]))
    assert found.item() == pytest.approx(math.sin(30.0 * (0.03 - 0.02 + 0.05)), abs=1e-6)


def test_weights_come_from_the_generator_alone() -> None:
    torch.manual_seed(1)
    one = new_field(4).state_dict()
    torch.manual_seed(2)
    same, other = new_field(4).state_dict(), new_field(5).state_dict()
    assert all(torch.equal(one[name], same[name]) for name in one)
    assert not torch.equal(one["near.0.weight"], other["near.0.weight"])


def test_a_field_is_asked_in_any_shape_of_points() -> None:
    field = new_field()
    points = torch.rand((3, 4, 3), generator=torch.Generator().manual_seed(1))
    assert field(points).shape == (3, 4)
    torch.testing.assert_close(field(points)[1, 2], field(points[1, 2]))

"""The field of Ultra-NeRF: its encoding, its size and its start."""

import math

import pytest
import torch

from ultragray_studies.methods.parts import encode
from ultragray_studies.methods.ultranerf import TissueField


def field(seed=0):
    return TissueField(torch.Generator().manual_seed(seed))


def test_a_point_becomes_itself_and_ten_octaves_of_sines_and_cosines():
    point = torch.tensor([math.pi / 2, 0.0, -math.pi / 4], dtype=torch.float64)
    encoded = encode(point)
    assert encoded.shape == (63,)
    half = math.sqrt(0.5)
    expected = [*point.tolist(), 1.0, 0.0, -half, 0.0, 1.0, half]  # p, then sin p and cos p
    expected += [0.0, 0.0, -1.0, -1.0, 1.0, 0.0]  # sin 2p, cos 2p
    torch.testing.assert_close(encoded[:15], torch.tensor(expected, dtype=torch.float64))
    torch.testing.assert_close(encoded[-6:-3], torch.sin(512.0 * point))
    torch.testing.assert_close(encoded[-3:], torch.cos(512.0 * point))


def test_the_encoding_joins_again_before_the_sixth_layer():
    module = field()
    layers = [one for one in module.modules() if isinstance(one, torch.nn.Linear)]
    assert [(one.in_features, one.out_features) for one in layers] == [
        (63, 128), *[(128, 128)] * 4, (191, 128), *[(128, 128)] * 2, (128, 5)
    ]  # fmt: skip
    with torch.no_grad():
        layers[4].weight.zero_()  # what came before the joint is gone
        raw = module(torch.rand(8, 3, generator=torch.Generator().manual_seed(0)))
    assert raw.shape == (8, 5)
    assert raw.std(dim=0).min() > 0.0


def test_weights_are_glorot_uniform_and_biases_zero():
    for layer in field().modules():
        if isinstance(layer, torch.nn.Linear):
            bound = math.sqrt(6.0 / (layer.in_features + layer.out_features))
            assert 0.95 * bound < layer.weight.abs().max() <= bound
            assert float(layer.weight.detach().std()) == pytest.approx(bound / math.sqrt(3.0), rel=0.1)
            assert not layer.bias.any()

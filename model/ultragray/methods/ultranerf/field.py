"""The field: a point of the scene becomes five raw numbers of its tissue; there is no view direction.

The point is encoded in ten octaves (63 numbers). Eight layers of 128 with ReLU follow; the encoding joins again before
the sixth, which sees 191 numbers. A linear head gives a, b, p_b, p_s and s (renderer.py says what becomes of them).
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from ultragray.methods.parts.encoding import encode, encoded_size

WIDTH = 128
LAYERS_BEFORE_JOIN, LAYERS_AFTER_JOIN = 5, 3
HEADS = 5


class Field(nn.Module):
    """132,485 parameters: weights by Glorot's uniform rule, drawn from a generator on the CPU; biases are 0."""

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__()
        inputs = encoded_size()
        self.before = _layers([inputs] + [WIDTH] * LAYERS_BEFORE_JOIN, generator)
        self.after = _layers([WIDTH + inputs] + [WIDTH] * LAYERS_AFTER_JOIN, generator)
        self.head = _layer(WIDTH, HEADS, generator)

    def forward(self, points: Tensor) -> Tensor:  # [N, 3] -> [N, 5]
        encoded = encode(points)
        hidden = encoded
        for layer in self.before:
            hidden = layer(hidden).relu_()
        hidden = torch.cat([hidden, encoded], dim=-1)
        for layer in self.after:
            hidden = layer(hidden).relu_()
        raw: Tensor = self.head(hidden)
        return raw


def _layers(sizes: list[int], generator: torch.Generator) -> nn.ModuleList:
    return nn.ModuleList(_layer(inputs, outputs, generator) for inputs, outputs in pairwise(sizes))


def _layer(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    layer = nn.Linear(inputs, outputs, device="meta").to_empty(device="cpu")  # else it draws from torch's own generator
    nn.init.xavier_uniform_(layer.weight, generator=generator)
    nn.init.zeros_(layer.bias)
    return layer

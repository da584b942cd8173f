"""The network of ImplicitVol: a grey value of a point, by sine layers over an octave encoding."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from ultragray.methods.parts.encoding import encode, encoded_size

WIDTH = 128
FIRST_FREQUENCY = 30.0
LAST_BIAS = 0.02


class SineLayer(nn.Module):
    """sin(w0 (W x + b)), W and b uniform in ±1/inputs where it is the first, else in ±√(6/inputs)/w0."""

    def __init__(self, inputs: int, outputs: int, frequency: float, bound: float) -> None:
        super().__init__()
        self.frequency, self.bound = frequency, bound
        self.weight = nn.Parameter(torch.empty(outputs, inputs))
        self.bias = nn.Parameter(torch.empty(outputs))

    @classmethod
    def first(cls, inputs: int, outputs: int) -> SineLayer:
        return cls(inputs, outputs, FIRST_FREQUENCY, 1.0 / inputs)

    @classmethod
    def later(cls, inputs: int, outputs: int) -> SineLayer:
        return cls(inputs, outputs, 1.0, math.sqrt(6.0 / inputs))

    def draw(self, generator: torch.Generator) -> None:
        """Draws the weights anew."""
        _draw_uniform([self.weight, self.bias], self.bound, generator)

    def forward(self, x: Tensor) -> Tensor:  # [..., inputs] -> [..., outputs]
        # The frequency goes to the weights, of which there are fewer than values.
        found: Tensor = functional.linear(x, self.frequency * self.weight, self.frequency * self.bias).sin()
        return found


class SineField(nn.Module):
    """Four sine layers, the encoded point once more, four sine layers, a linear one, a sine layer, a linear one to 1.

    156,673 parameters; nothing limits the value. The generator is one of the CPU.
    """

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__()
        point = encoded_size()
        later = SineLayer.later
        self.near = nn.Sequential(SineLayer.first(point, WIDTH), *(later(WIDTH, WIDTH) for _ in range(3)))
        self.far = nn.Sequential(later(WIDTH + point, WIDTH), *(later(WIDTH, WIDTH) for _ in range(3)))
        self.middle = nn.Linear(WIDTH, WIDTH)
        self.narrow = later(WIDTH, WIDTH // 2)
        self.last = nn.Linear(WIDTH // 2, 1)
        self.draw(generator)

    def draw(self, generator: torch.Generator) -> None:
        """Draws all weights anew, in the order of the layers; linear layers uniform in ±1/√inputs."""
        for layer in self.modules():
            if isinstance(layer, SineLayer):
                layer.draw(generator)
            if isinstance(layer, nn.Linear):
                _draw_uniform([layer.weight, layer.bias], 1.0 / math.sqrt(layer.in_features), generator)
        nn.init.constant_(self.last.bias, LAST_BIAS)

    def forward(self, points: Tensor) -> Tensor:  # [..., 3] -> [...]
        encoded = encode(points)
        found = self.far(torch.cat([self.near(encoded), encoded], dim=-1))
        value: Tensor = self.last(self.narrow(self.middle(found)))
        return value.squeeze(-1)


def _draw_uniform(parameters: Sequence[Tensor], bound: float, generator: torch.Generator) -> None:
    with torch.no_grad():
        for parameter in parameters:
            parameter.copy_(torch.empty(parameter.shape).uniform_(-bound, bound, generator=generator))

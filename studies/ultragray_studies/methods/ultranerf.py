"""The field: a point of the scene becomes five raw numbers of its tissue; there is no view direction.

The point is encoded in ten octaves (63 numbers). Eight layers of 128 with ReLU follow; the encoding joins again before
the sixth, which sees 191 numbers. A linear head gives a, b, p_b, p_s and s (renderer.py says what becomes of them).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from ultragray.errors import DatasetInvalid
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.learn.sweep import Dataset, Sweep
from ultragray_studies.methods.learner import LearnedMethod, Learner
from ultragray_studies.methods.method import Budget, Description
from ultragray_studies.methods.parts import Box, Similarity, as_tensor, encode, encoded_size, pixel_points_mm

WIDTH = 128
LAYERS_BEFORE_JOIN, LAYERS_AFTER_JOIN = 5, 3
HEADS = 5


class TissueField(nn.Module):
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


# The renderer: what a beam keeps on its way along each scan line, and what it sends back from each sample.
#
# Convention. Maps are [H, W]: row i is the i-th sample along scan line j, its column, from the face on. Products and
# sums over j < i leave the sample itself out, so that the first one sees the whole beam. For any probe, the samples
# of a frame are its pixels: range times angle for a fan.


KERNEL_SIDE = 7  # pixels
KERNEL_SIGMAS = (1.0, 2.0)  # pixels, along depth and across scan lines


@dataclass(frozen=True, eq=False)
class Tissue:
    """What the field says of each sample."""

    attenuation: Tensor  # [H, W] α = |a|, per unit of length of the field's coordinates
    reflectance: Tensor  # [H, W] β = σ(b)
    border: Tensor  # [H, W] ρ_b = σ(p_b), the probability of a border
    scatterer: Tensor  # [H, W] ρ_s = σ(p_s), the probability of a scatterer
    amplitude: Tensor  # [H, W] φ = σ(s), of a scatterer

    @classmethod
    def of(cls, raw: Tensor) -> Tissue:  # [H, W, 5]
        a, *others = raw.unbind(-1)
        return cls(a.abs(), *(one.sigmoid() for one in others))


def expected_frame(tissue: Tissue, spacing: float) -> Tensor:  # -> [H, W]
    """The frame with each draw replaced by its probability, differentiable in all five maps.

    It is the mean over all draws for the scattering. For the reflection it is an approximation, as K reaches shallower
    borders that also weaken the beam. `spacing` is the distance between samples in the field's coordinates.
    """
    return _frame(tissue, tissue.border, tissue.scatterer, spacing)


def drawn_frame(tissue: Tissue, spacing: float, generator: torch.Generator) -> Tensor:  # -> [H, W]
    """The frame of one draw of borders and scatterers. Neither probability gets a gradient: draws are yes or no."""
    chances = torch.stack([tissue.border, tissue.scatterer]).detach()  # [2, H, W]
    uniform = torch.rand(chances.shape, generator=generator).to(chances)  # from the CPU: the same on every device
    border, scatterer = (uniform < chances).to(chances.dtype)
    return _frame(tissue, border, scatterer, spacing)


def transmission(tissue: Tissue, border: Tensor, spacing: float) -> Tensor:  # -> [H, W]
    """T = Π_{j<i} exp(−α_j Δ) · Π_{j<i} (1 − β_j G_j): what is left of the beam when it reaches a sample."""
    depth = _shifted(tissue.attenuation * spacing, 0.0).cumsum(0)
    passed = _shifted(1.0 - tissue.reflectance * border, 1.0).cumprod(0)
    return torch.exp(-depth) * passed


def point_spread(like: Tensor) -> Tensor:  # [7, 7]
    """K: a Gaussian whose sum is 1; its rows lie along depth, and it is wider across scan lines."""
    offsets = torch.arange(KERNEL_SIDE, dtype=like.dtype, device=like.device) - KERNEL_SIDE // 2
    along, across = (torch.softmax(-0.5 * (offsets / sigma).square(), dim=0) for sigma in KERNEL_SIGMAS)
    return torch.outer(along, across)


def _frame(tissue: Tissue, border: Tensor, scatterer: Tensor, spacing: float) -> Tensor:
    """I = T · β · (K * G) + T · (K * (H ⊙ φ)), not clipped."""
    sources = torch.stack([border, scatterer * tissue.amplitude])[:, None]  # [2, 1, H, W]
    spread = functional.conv2d(sources, point_spread(border)[None, None], padding=KERNEL_SIDE // 2)[:, 0]
    return transmission(tissue, border, spacing) * (tissue.reflectance * spread[0] + spread[1])


def _shifted(rows: Tensor, first: float) -> Tensor:  # [H, W] -> [H, W]
    """Each row one deeper, and a first row of one value; the last one, which nothing lies under, is left out."""
    return torch.cat([torch.full_like(rows[:1], first), rows[:-1]])


# Ultra-NeRF as methods: its learner, and the variants of it that are compared.


PUBLISHED_STEPS = 200_000
RATE = 1e-4
DECADES = PUBLISHED_STEPS / 250_000  # that the rate falls over all steps: it is 0.1^(step / 250,000) as published
SIMILARITY_WEIGHT = 0.75  # λ
SIMILARITY = Similarity(window=7, sigma=1.5, k1=0.01, k2=0.1)
CHUNK_POINTS = 200_000  # of a frame that is rendered, at once


@dataclass(frozen=True, eq=False)
class Coordinates:
    """What the field sees: points from an origin, in units of some mm."""

    origin_mm: FloatArray | float  # [3] in the tracker's frame
    unit_mm: float

    @classmethod
    def metres(cls, sweep: Sweep) -> Coordinates:
        """Metres in the tracker's frame. The finest period of the encoding is 2π/512 m, or 12.3 mm."""
        return cls(0.0, 1000.0)

    @classmethod
    def scaled(cls, sweep: Sweep) -> Coordinates:
        """[-1, 1] over the longest side of the box of the training frames, the others in proportion."""
        box = Box.of(sweep)
        return cls(box.centre_mm, box.largest_half_mm)

    def of(self, points_mm: FloatArray) -> FloatArray:  # [..., 3] -> [..., 3]
        coordinates: FloatArray = (points_mm - self.origin_mm) / self.unit_mm
        return coordinates


class UltraNerfLearner(Learner):
    """The field and its Adam. A step is one whole training frame, drawn uniformly with replacement.

    The loss is λ (1 − MS-SSIM) + (1 − λ) MSE. MS-SSIM has five scales where the shorter side has 112 pixels or more;
    a smaller frame has as many as hold its window of 7 pixels, their weights adding to 1.

    Raises DatasetInvalid for frames that hold no such window.
    """

    module: TissueField

    def __init__(self, dataset: Dataset, seed: int, device: torch.device, coordinates: Coordinates) -> None:
        height, width = dataset.train.height, dataset.train.width
        if min(height, width) < SIMILARITY.window:
            raise DatasetInvalid(
                f"{dataset.train.source}: Ultra-NeRF's loss needs frames of at least {SIMILARITY.window} pixels a "
                f"side, got {height}x{width}"
            )
        super().__init__(dataset, seed, device)
        self.coordinates = coordinates
        self.module = TissueField(self.generator).to(device)
        self.optimizers = {"adam": torch.optim.Adam(self.module.parameters(), lr=RATE)}

    def loss(self, step: int, steps: int) -> Tensor:
        for group in self.optimizers["adam"].param_groups:
            group["lr"] = RATE * 0.1 ** (DECADES * step / steps)
        place = int(torch.randint(len(self.images), (), generator=self.generator))
        image, pose, probe = self.image(place), self.dataset.train.poses[place], self.dataset.probe
        height, width = image.shape
        raw = self.module(self._points(probe, pose, height, width)).view(height, width, -1)
        frame = self.training_frame(Tissue.of(raw), self._spacing(probe, height))
        similarity = SIMILARITY.ms_ssim(frame[None], image[None])
        error = (frame - image).square().mean()
        return SIMILARITY_WEIGHT * (1.0 - similarity) + (1.0 - SIMILARITY_WEIGHT) * error

    def training_frame(self, tissue: Tissue, spacing: float) -> Tensor:  # -> [H, W]
        """The frame that a step compares with the real one."""
        return expected_frame(tissue, spacing)

    def frame(self, probe: Probe, pose: FloatArray, height: int, width: int) -> Tensor:  # [H, W]
        points = self._points(probe, pose, height, width)
        raw = torch.cat([self.module(chunk) for chunk in torch.split(points, CHUNK_POINTS)]).view(height, width, -1)
        return expected_frame(Tissue.of(raw), self._spacing(probe, height)).clamp(0.0, 1.0)

    def _points(self, probe: Probe, pose: FloatArray, height: int, width: int) -> Tensor:  # [H·W, 3]
        points = self.coordinates.of(pixel_points_mm(probe, pose, height, width))
        return as_tensor(points.reshape(-1, 3), self.device)

    def _spacing(self, probe: Probe, height: int) -> float:
        return probe.scan_line_length_mm / height / self.coordinates.unit_mm


class DrawingLearner(UltraNerfLearner):
    """Draws borders and scatterers in training, from its own generator; what it renders is expected all the same."""

    def training_frame(self, tissue: Tissue, spacing: float) -> Tensor:
        return drawn_frame(tissue, spacing, self.generator)


@dataclass(frozen=True)
class UltraNerf(LearnedMethod):
    """A variant: the coordinates that the field sees, and how a frame is made in training."""

    name: str
    variant: str
    summary: str
    coordinates: Callable[[Sweep], Coordinates]
    learns: type[UltraNerfLearner]
    choices: tuple[str, ...]

    def describe(self) -> Description:
        return Description(
            title=f"Ultra-NeRF ({self.variant})",
            source="Wysocki et al., MIDL 2023, arXiv 2301.10520",
            summary=self.summary,
            equations=EQUATIONS,
            choices=(*self.choices, *CHOICES),
            published_steps=PUBLISHED_STEPS,
        )

    def learner(self, dataset: Dataset, budget: Budget, seed: int, device: torch.device) -> UltraNerfLearner:
        return self.learns(dataset, seed, device, self.coordinates(dataset.train))


EQUATIONS = (
    "α = |a|, β = σ(b), ρ_b = σ(p_b), ρ_s = σ(p_s), φ = σ(s), of the field's five numbers at each sample",
    "G ~ Bernoulli(ρ_b), H ~ Bernoulli(ρ_s)",
    "T(i) = Π_{j<i} exp(-α_j Δ) · Π_{j<i} (1 - β_j G_j)",
    "I = T · β · (K * G) + T · (K * (H ⊙ φ)), K a Gaussian of 7x7, 1 pixel along depth and 2 across",
    "L = 0.75 (1 - MS-SSIM) + 0.25 MSE",
)
CHOICES = (
    "Held-out frames are rendered by their expectation, G = ρ_b and H = ρ_s, and clipped to [0, 1].",
    "Samples lie at the centres of the frame's pixels, along depth and across, not from end to end with both included.",
    "Δ, the distance between samples, is in the coordinates that the field sees, and so is 1/α.",
    "Probes other than linear ones, which the paper leaves out: the same formulas along their scan lines, K in pixels "
    "of range times angle.",
    "λ is 0.75, as the released program has it (0.9 in the paper's appendix). MS-SSIM takes fewer than five scales "
    "where the shorter side has less than 112 pixels; a scale of negative contrast counts as 1e-6.",
    "The rate falls to 0.1^0.8 of 1e-4 over the steps of the budget, as it does over 200,000 steps.",
    "Draws are new in each step, from the seed of the fit; Adam's constants are torch's.",
)
_METRES = "Coordinates are metres in the tracker's frame: the finest period of the encoding is 12.3 mm."
_SCALED = (
    "Coordinates are scaled so that the longest side of the training frames' box spans [-1, 1]: the finest period of "
    "the encoding is 0.6% of that side. The released program takes metres."
)
_DRAWN = "Borders and scatterers are drawn in training, so that p_b and p_s get no gradient of their own."
_MEAN = "The expectation takes the place of the draws in training too, so that p_b and p_s are learned."

VARIANTS = (
    UltraNerf(
        name="ultranerf-released",
        variant="released",
        summary="A neural field of tissue parameters and a ray model with random borders and scatterers, in metres.",
        coordinates=Coordinates.metres,
        learns=DrawingLearner,
        choices=(_METRES, _DRAWN),
    ),
    UltraNerf(
        name="ultranerf-unit",
        variant="unit",
        summary="Ultra-NeRF as released, but for coordinates scaled to [-1, 1]: finer detail is within its encoding.",
        coordinates=Coordinates.scaled,
        learns=DrawingLearner,
        choices=(_SCALED, _DRAWN),
    ),
    UltraNerf(
        name="ultranerf-mean",
        variant="mean",
        summary="Ultra-NeRF in scaled coordinates that learns from the expected frame: all five maps get gradients.",
        coordinates=Coordinates.scaled,
        learns=UltraNerfLearner,
        choices=(_SCALED, _MEAN),
    ),
)

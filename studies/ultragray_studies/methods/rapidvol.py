"""RapidVol (Eid et al., arXiv 2404.10766): a volume as products of three feature planes, decoded by a small network."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from ultragray.learn.sweep import Dataset
from ultragray_studies.methods.method import Description
from ultragray_studies.methods.parts import PUBLISHED_FRAMES, Box, EpochMethod, SliceLearner

RANK, CELLS = 16, 128  # features of a plane, and its nodes along each side
HIDDEN = 64
PLANE_SPREAD = 0.1  # features begin in 1 ± this
FIRST_VALUE = 0.5  # the field begins near it: SSIM is 1 for an image's negative -I too, where a start below 0 leads
PLANE_RATE, DECODER_RATE = 1e-2, 1e-3
EPOCHS = 5_000
LEAST_HALF_MM = 1.0  # of the box of frames that lie in one plane
PLANES = ((0, 1), (1, 2), (0, 2))  # the axes of each: the first along its columns, the second along its rows


class TriPlanes(nn.Module):
    """v(x, y, z) = MLP(P_xy(x, y) P_yz(y, z) P_xz(x, z)), the product feature by feature, planes read bilinearly.

    Nodes at the ends of a side lie at -1 and 1; beyond them the value at the end goes on.
    """

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__()
        spread = torch.rand((len(PLANES), RANK, CELLS, CELLS), generator=generator) * 2.0 - 1.0
        self.planes = nn.Parameter(1.0 + PLANE_SPREAD * spread)  # [3, R, rows, columns]
        self.decoder = nn.Sequential(
            nn.Linear(RANK, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 1)
        )
        with torch.no_grad():
            for layer in self.decoder:
                if isinstance(layer, nn.Linear):
                    bound = 1.0 / math.sqrt(layer.in_features)
                    for parameter in layer.parameters():
                        parameter.uniform_(-bound, bound, generator=generator)
            last = self.decoder[-1]
            assert isinstance(last, nn.Linear)
            last.weight.div_(math.sqrt(HIDDEN))
            last.bias.fill_(FIRST_VALUE)

    def products(self, points: Tensor) -> Tensor:  # [H, W, 3] -> [H, W, R]
        """The product of the three planes' features at points."""
        grids = torch.stack([points[..., list(axes)] for axes in PLANES])  # [3, H, W, 2]
        features = functional.grid_sample(self.planes, grids, padding_mode="border", align_corners=True)
        return features.prod(dim=0).permute(1, 2, 0)

    def forward(self, points: Tensor) -> Tensor:  # [H, W, 3] -> [H, W]
        value: Tensor = self.decoder(self.products(points))
        return value.squeeze(-1)


class TriPlaneLearner(SliceLearner):
    """A fit of the planes and their decoder."""

    def __init__(self, dataset: Dataset, seed: int, device: torch.device) -> None:
        box = Box.of(dataset.train)
        super().__init__(dataset, seed, device, box.centre_mm, np.maximum(box.half_mm, LEAST_HALF_MM))
        self.field = TriPlanes(self.generator).to(device)
        self.module = self.field
        self.optimizers = {
            "planes": torch.optim.Adam([self.field.planes], PLANE_RATE),
            "decoder": torch.optim.Adam(self.field.decoder.parameters(), DECODER_RATE),
        }

    def rates(self, step: int, steps: int) -> dict[str, float]:
        decay = 0.01 ** (step / steps)
        return {"planes": PLANE_RATE * decay, "decoder": DECODER_RATE * decay}


class RapidVol(EpochMethod):
    """The tri-planes of RapidVol, as far as they are published."""

    name, epochs, learns = "rapidvol", EPOCHS, TriPlaneLearner

    def describe(self) -> Description:
        return Description(
            title="RapidVol-like tri-planes",
            source="Eid et al., arXiv 2404.10766",
            summary="Three planes of features, read bilinearly and multiplied, become a grey value in a small network.",
            equations=(
                "f_r(x, y, z) = Pxy_r(x, y) Pyz_r(y, z) Pxz_r(x, z), r = 1 ... 16",
                "v = MLP(f_1, ..., f_16)",
                "loss = 1 - SSIM(v, image)",
            ),
            choices=(
                "No code is published, and rank, sizes, rates and schedule could not be verified in the paper. This "
                "project's: 16 features, planes of 128 x 128, two hidden layers of 64 with ReLU.",
                "This project's: Adam with 1e-2 for the planes and 1e-3 for the network, both falling to 1%.",
                "This project's: 5,000 epochs of one step a frame as the author's recipe, half of ImplicitVol's.",
                "SSIM is ImplicitVol's: window 5, sigma 1.5, zeros around the image.",
                "Each axis of the box around the training frames is scaled to [-1, 1] by its own half extent.",
                "Features begin uniform in 1 ± 0.1, so that no product is near zero, where its gradient would vanish.",
                "The field begins near 1/2 everywhere (bias of the last layer 1/2, its weights in ±1/64): SSIM is "
                "1 for the image times -1 too, and fits that began below 0 ended there.",
                "It starts from no atlas.",
            ),
            published_steps=EPOCHS * PUBLISHED_FRAMES,
        )

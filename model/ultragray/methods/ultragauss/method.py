"""UltraGauss as a method: v1 of its paper, and with the shadow of the version at ICLR."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ultragray.datasets.sweep import Dataset
from ultragray.methods.budget import Budget, BudgetKind
from ultragray.methods.learner import LearnedMethod
from ultragray.methods.method import Description
from ultragray.methods.ultragauss.learner import UltraGaussLearner
from ultragray.methods.ultragauss.start import even_start, wide_start
from ultragray.training.config import TrainingConfig
from ultragray.training.data.geometry import Geometry

STEPS = 30_000
GAUSSIANS = 300_000  # of the author's recipe


@dataclass(frozen=True)
class UltraGauss(LearnedMethod):
    """Weighted Gaussians, averaged pixel by pixel."""

    name: str = "ultragauss"
    casts_shadow: bool = False

    def describe(self) -> Description:
        average = "C = (sum(w c) + a_BG c_BG) / (sum(w) + a_BG), w = a exp(-d'Ad / 2)"
        shadow = "image = T C, T(p) = exp(-k sum(W delta)) down the scan line to p, p included, W = sum(w)"
        return Description(
            title="UltraGauss with shadow" if self.casts_shadow else "UltraGauss",
            source="Eid, Namburete and Henriques, arXiv 2505.05643" + (", ICLR 2026" if self.casts_shadow else ""),
            summary="3D Gaussians cut by the image plane, their intensities averaged by weight and density"
            + (", darkened by what lies above." if self.casts_shadow else "; nothing casts a shadow."),
            equations=(average, shadow) if self.casts_shadow else (average,),
            choices=(
                "From secondary sources: the paper's code was not found.",
                "Equal time: as many Gaussians as this project's scene takes for the sweep, their standard deviation "
                "(volume / N)^(1/3), across the frames at least half the spacing of these. Author's recipe: 300,000 "
                "with the published start.",
                "Steps are not published: 30,000, one frame each. Rates not published: those of 3D Gaussian Splatting.",
                "Loss weights not published: L1 and 1 - SSIM, half each.",
                "Densify and resample every 100 steps within the first half: weights under 0.005 go, those that the "
                "images pull most are split or duplicated in their place; never more Gaussians than at the start.",
                "A from standard deviations and a rotation; L L' + beta, beta = 1e-6, is used for the published start.",
                "a_BG starts at 0.1, c_BG at 0.05; both are learned.",
                "A Gaussian counts where w is at least 1/255 (published: within 95% of its mass), w is at most 0.999, "
                "and it counts nowhere with its mean before the face or beyond the last row.",
                *(
                    ("The unit of delta is not published: k is learned, from an optical depth of 0.1 on.",)
                    if self.casts_shadow
                    else ()
                ),
            ),
            published_steps=STEPS,
        )

    def learner(self, dataset: Dataset, budget: Budget, seed: int, device: torch.device) -> UltraGaussLearner:
        generator = torch.Generator().manual_seed(seed)
        match budget.kind:
            case BudgetKind.AUTHOR:
                gaussians = wide_start(dataset, GAUSSIANS, generator)
            case BudgetKind.EQUAL:
                config = TrainingConfig.preset("fast").resolved(Geometry.of(dataset))
                assert config.max_gaussians is not None
                gaussians = even_start(dataset, config.max_gaussians, generator)
        return UltraGaussLearner(dataset, seed, device, gaussians, casts_shadow=self.casts_shadow)

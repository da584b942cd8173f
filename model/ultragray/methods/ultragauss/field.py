"""All that UltraGauss learns: the Gaussians, the background, and the density that casts shadows."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from ultragray.backends.weighted import WeightedSums
from ultragray.methods.ultragauss.renderer import average, shadow
from ultragray.probe import FloatArray
from ultragray.scene import GaussianScene
from ultragray.scene_info import SceneInfo

GAUSSIANS = ("means", "scales", "quats", "transmittances", "sh0")  # the parameters with a row for each Gaussian
START_BACKGROUND_WEIGHT = 0.1  # of one Gaussian at its centre
START_BACKGROUND_LOGIT = -3.0  # c_BG = 0.05
START_DENSITY = 1.0  # 1/cm; a fit sets it by what its first image weighs


class Field(nn.Module):
    """Raw parameters; `transmittances` holds the logits of the weights (`ultragray.backends.weighted`)."""

    def __init__(self, gaussians: Mapping[str, Tensor], *, casts_shadow: bool) -> None:
        super().__init__()
        self.replace(gaussians)
        device = gaussians["means"].device
        self.background_weight = nn.Parameter(torch.tensor(math.log(START_BACKGROUND_WEIGHT), device=device))  # log
        self.background_intensity = nn.Parameter(torch.tensor(START_BACKGROUND_LOGIT, device=device))  # logit
        if casts_shadow:
            self.density = nn.Parameter(torch.tensor(math.log(START_DENSITY), device=device))  # log of κ, 1/cm
        self.casts_shadow = casts_shadow

    def replace(self, gaussians: Mapping[str, Tensor]) -> None:
        """Goes on with other Gaussians, any number of them."""
        for name in GAUSSIANS:
            setattr(self, name, nn.Parameter(gaussians[name].detach().clone()))

    @property
    def gaussians(self) -> dict[str, Tensor]:
        """The parameters with a row for each Gaussian."""
        parameters = dict(self.named_parameters())
        return {name: parameters[name] for name in GAUSSIANS}

    def scene(self, centre_mm: FloatArray) -> GaussianScene:
        """The same tensors as the kernels take them; never saved, as its transmittances are weights."""
        gaussians = self.gaussians
        count = len(gaussians["means"])
        info = SceneInfo(centre_mm=centre_mm.tolist(), intensity="sigmoid", gaussian_count=count)
        return GaussianScene(**gaussians, shN=gaussians["sh0"].detach()[:, :0], info=info)  # type: ignore[arg-type]

    def image(self, sums: WeightedSums, row_cm: float) -> Tensor:  # [C, H, W]
        """C, or T·C where shadows are cast."""
        image = average(*sums, self.background_weight.exp(), self.background_intensity.sigmoid())
        return image * shadow(sums.weight, self.density.exp(), row_cm) if self.casts_shadow else image

"""The methods by name. A new one is a module, a line here, and its name in `names`."""

from __future__ import annotations

from collections.abc import Sequence

from ultragray.learn.evaluation.methods import chosen_names
from ultragray_studies.methods.classical import PAPER_VOXEL_MM, Compounding, FromFrames, InTime
from ultragray_studies.methods.gaussians import SceneMethod
from ultragray_studies.methods.implicitvol import ImplicitVol
from ultragray_studies.methods.method import Method
from ultragray_studies.methods.rapidvol import RapidVol
from ultragray_studies.methods.ultragauss import UltraGauss
from ultragray_studies.methods.ultranerf import VARIANTS as ULTRANERF

METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        SceneMethod(),
        *(Compounding(fold) for fold in ("median", "mean", "maximum")),
        *(Compounding(fold, PAPER_VOXEL_MM) for fold in ("median", "mean", "maximum")),
        FromFrames("linear"),
        FromFrames("nearest"),
        InTime(),
        *ULTRANERF,
        ImplicitVol(),
        ImplicitVol(refines=True),
        RapidVol(),
        UltraGauss(),
        UltraGauss("ultragauss-shadow", casts_shadow=True),
    )
}


def chosen_methods(names: Sequence[str]) -> dict[str, Method]:
    """The methods that these words choose, see `chosen_names`. Raises InvalidArgument."""
    return {name: METHODS[name] for name in chosen_names(names)}

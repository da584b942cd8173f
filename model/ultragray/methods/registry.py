"""The methods by name. A new one is a module, and a line here."""

from __future__ import annotations

from collections.abc import Sequence

from ..errors import InvalidArgument
from .classical import PAPER_VOXEL_MM, Compounding, FromFrames
from .gaussians import SceneMethod
from .implicitvol.method import ImplicitVol, RefinedImplicitVol
from .method import Method
from .rapidvol import RapidVol
from .ultragauss.method import UltraGauss
from .ultranerf.method import VARIANTS as ULTRANERF

ALL = "all"

METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        SceneMethod(),
        *(Compounding(fold) for fold in ("median", "mean", "maximum")),
        *(Compounding(fold, PAPER_VOXEL_MM) for fold in ("median", "mean", "maximum")),
        FromFrames("linear"),
        FromFrames("nearest"),
        *ULTRANERF,
        ImplicitVol(),
        RefinedImplicitVol(),
        RapidVol(),
        UltraGauss(),
        UltraGauss("ultragauss-shadow", casts_shadow=True),
    )
}


def chosen_methods(names: Sequence[str]) -> dict[str, Method]:
    """The methods of these names in the order of METHODS; `all` is each of them. Raises InvalidArgument."""
    for name in names:
        if name not in METHODS and name != ALL:
            raise InvalidArgument(f"methods must be some of {ALL}, {', '.join(METHODS)}, got {name!r}", field="methods")
    if not names:
        raise InvalidArgument(f"methods must name at least one of {', '.join(METHODS)}, got none", field="methods")
    return {name: method for name, method in METHODS.items() if name in names or ALL in names}

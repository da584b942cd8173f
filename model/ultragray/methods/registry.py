"""The methods by name. A new one is a module, a line here, and its name in `names`."""

from __future__ import annotations

from collections.abc import Sequence

from .classical import PAPER_VOXEL_MM, Compounding, FromFrames
from .gaussians import SceneMethod
from .method import Method
from .names import chosen_names

METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        SceneMethod(),
        *(Compounding(fold) for fold in ("median", "mean", "maximum")),
        *(Compounding(fold, PAPER_VOXEL_MM) for fold in ("median", "mean", "maximum")),
        FromFrames("linear"),
        FromFrames("nearest"),
    )
}


def chosen_methods(names: Sequence[str]) -> dict[str, Method]:
    """The methods that these words choose, see `chosen_names`. Raises InvalidArgument."""
    return {name: METHODS[name] for name in chosen_names(names)}

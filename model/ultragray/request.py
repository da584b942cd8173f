"""What may be asked of a renderer: outputs and image sizes, checked without torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .errors import InvalidArgument, InvalidImageSize, UnknownOutput
from .scene_info import SceneInfo

OUTPUTS = ("bmode", "echo", "transmittance", "coverage")  # in [0, 1]
LABELS = "labels"
ALL_OUTPUTS = (*OUTPUTS, LABELS)
WEIGHT_SUM = "weight_sum"  # S, which backends give for labels; without a gradient
MAX_IMAGE_SIDE = 4096


def check_outputs(outputs: Sequence[str], *, field: str = "outputs") -> tuple[str, ...]:
    """`outputs` without repetitions, in the given order. Raises UnknownOutput for an unknown name or an empty list."""
    names = (outputs,) if isinstance(outputs, str) else tuple(outputs)
    for name in names:
        if name not in ALL_OUTPUTS:
            raise UnknownOutput(f"{field} must be some of {', '.join(ALL_OUTPUTS)}, got {name!r}", field=field)
    if not names:
        raise UnknownOutput(f"{field} must name at least one of {', '.join(ALL_OUTPUTS)}, got none", field=field)
    return tuple(dict.fromkeys(names))


def check_labelled(outputs: Sequence[str], info: SceneInfo, *, field: str = "outputs") -> None:
    """Raises UnknownOutput where labels are asked of a scene whose Gaussians carry none."""
    if LABELS in outputs and not info.label_names:
        raise UnknownOutput(
            f"{field} may name {LABELS} only for a scene whose Gaussians carry labels; this one's carry none",
            field=field,
        )


def check_min_confidence(limit: float | None, info: SceneInfo) -> None:
    """Raises InvalidArgument for a `min_confidence` that no frame of a scene could have; None asks for none."""
    if limit is None:
        return
    if not 0.0 <= limit <= 1.0:
        raise InvalidArgument(f"min_confidence must be from 0 to 1, got {limit:g}", field="min_confidence")
    if not info.confidence:
        raise InvalidArgument(
            "min_confidence needs a scene that knows the confidence of its frames; this one was trained without",
            field="min_confidence",
        )


def check_image_size(height: Any, width: Any, *, limit: int = MAX_IMAGE_SIDE) -> None:
    """Raises InvalidImageSize unless both sides are integers from 1 to `limit`."""
    for name, value in (("height", height), ("width", width)):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 1 <= value <= limit:
            raise InvalidImageSize(f"{name} must be an integer from 1 to {limit}, got {value!r}", field=name)

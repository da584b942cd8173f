"""What may be asked of a renderer: outputs and image sizes, checked without torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .errors import InvalidImageSize, UnknownOutput

OUTPUTS = ("bmode", "echo", "transmittance", "coverage")
MAX_IMAGE_SIDE = 4096


def check_outputs(outputs: Sequence[str], *, field: str = "outputs") -> tuple[str, ...]:
    """`outputs` without repetitions, in the given order. Raises UnknownOutput for an unknown name or an empty list."""
    names = (outputs,) if isinstance(outputs, str) else tuple(outputs)
    for name in names:
        if name not in OUTPUTS:
            raise UnknownOutput(f"{field} must be some of {', '.join(OUTPUTS)}, got {name!r}", field=field)
    if not names:
        raise UnknownOutput(f"{field} must name at least one of {', '.join(OUTPUTS)}, got none", field=field)
    return tuple(dict.fromkeys(names))


def check_image_size(height: Any, width: Any, *, limit: int = MAX_IMAGE_SIDE) -> None:
    """Raises InvalidImageSize unless both sides are integers from 1 to `limit`."""
    for name, value in (("height", height), ("width", width)):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 1 <= value <= limit:
            raise InvalidImageSize(f"{name} must be an integer from 1 to {limit}, got {value!r}", field=name)

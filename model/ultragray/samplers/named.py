"""Samplers by their kind: to and from JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields
from typing import Any

from ..errors import InvalidArgument
from .around import AroundSampler
from .covered import CoveredSampler
from .fan import FanSampler
from .sampler import Sampler
from .spline import SplineSampler
from .training import TrainingSampler

_Class = type[TrainingSampler] | type[AroundSampler] | type[SplineSampler] | type[FanSampler] | type[CoveredSampler]
SAMPLERS: dict[str, _Class] = {
    cls.kind: cls for cls in (TrainingSampler, AroundSampler, SplineSampler, FanSampler, CoveredSampler)
}


def sampler_to_dict(sampler: Sampler) -> dict[str, Any]:
    """The sampler as a JSON object: `{"kind": "fan", "tilt_deg": 10.0, "step_deg": 2.5}`."""
    cls = SAMPLERS[sampler.kind]
    values = {item.name: getattr(sampler, item.name) for item in fields(cls)}
    return {"kind": sampler.kind} | {name: value for name, value in values.items() if value is not None}


def sampler_from_dict(document: Any) -> Sampler:
    """Inverse of `sampler_to_dict`; what is left out or null keeps its default. Raises InvalidArgument."""
    if not isinstance(document, Mapping):
        raise InvalidArgument(f"sampler must be an object, got {_told(document)}", field="kind")
    values = {name: value for name, value in document.items() if value is not None}
    kind = values.pop("kind", None)
    if not isinstance(kind, str) or kind not in SAMPLERS:
        raise InvalidArgument(f"kind must be one of {', '.join(SAMPLERS)}, got {_told(kind)}", field="kind")
    cls = SAMPLERS[kind]
    known = {item.name: item for item in fields(cls)}
    for name in values:
        if name not in known:
            takes = ", ".join(known) or "nothing else"
            raise InvalidArgument(
                f"{str(name)[:100]} is not of sampler {kind}: it takes {takes}", field=str(name)[:100]
            )
    for name, item in known.items():
        if name not in values and item.default is MISSING:
            raise InvalidArgument(f"{name} is required by sampler {kind}", field=name)
    return cls(**values)


def _told(value: Any) -> str:
    told = repr(value)
    return told if len(told) <= 100 else f"{told[:100]}…"

"""The base poses themselves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ultragray.contract import kind_field
from ultragray.probe import FloatArray, Probe
from ultragray.samplers.sampler import Sampler


@dataclass(frozen=True)
class TrainingSampler(Sampler):
    """The training poses of the scene as they are, in order."""

    kind: Literal["training"] = kind_field("training")

    def _made(self, base: FloatArray, probe: Probe) -> FloatArray:
        return base

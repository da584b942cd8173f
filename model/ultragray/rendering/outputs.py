"""The outputs of a renderer: what can be asked for at each pixel, and how each follows from what the backends draw.

An output is known by being registered here: to every door, to the contract of gRPC (`make generate`), to files and to
the console. Its values have a unit and a scale. Free of torch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from ultragray.errors import UnknownOutput

if TYPE_CHECKING:
    from torch import Tensor

    from ultragray.rendering.derived import Drawing
    from ultragray.scene.info import SceneInfo


PLANES = ("bmode", "echo", "transmittance", "coverage")  # what a backend draws, in [0, 1], with gradients
WEIGHT_SUM, INTENSITY_SUM = "weight_sum", "intensity_sum"  # S and ΣI·w of docs/physics.md §3
SUMS = (WEIGHT_SUM, INTENSITY_SUM)  # which backends draw too, with gradients
SPENT_BEAM = 1e-4  # a transmittance below it is noise: nothing can be said of what is taken from it
_Values = TypeVar("_Values", "npt.NDArray[Any]", "Tensor")
_AMOUNTS, _NUMBERS = np.dtype("<f4"), np.dtype("u1")


@dataclass(frozen=True)
class Output:
    """One quantity of each pixel."""

    name: str
    meaning: str
    planes: tuple[str, ...]  # the planes that the backends draw for it
    derive: Callable[[Drawing], Tensor]  # the output [C, H, W] of a drawing
    # float32: amounts. uint8: numbers that stand for something, which nothing may interpolate or scale
    dtype: np.dtype[Any] = _AMOUNTS
    unit: str = "1"  # of its values, such as dB/cm; 1: a share
    # the values that 8 bits hold as 0 and as 255; those beyond are held as these. float32 holds the values
    scale: tuple[float, float] = (0.0, 1.0)
    is_toned: bool = False  # whether gain, dynamic range and time-gain compensation change it
    shows_tools_alone: bool = False  # whether a scene that does not give it gives it of tools
    tells_support: bool = False  # whether it keeps its values where pixels without support are blackened
    # the scenes that give it, in words, where a scene does not; None where it does
    lacks: Callable[[SceneInfo], str | None] = lambda _: None

    @property
    def is_numbers(self) -> bool:
        return self.dtype == _NUMBERS

    @property
    def range_in_words(self) -> str:
        """Its values, such as "0 to 1" or "-60 to 0 dB"."""
        if self.is_numbers:
            return "whole numbers"
        low, high = self.scale
        return f"{low:g} to {high:g}" + ("" if self.unit == "1" else f" {self.unit}")

    @property
    def about(self) -> str:
        """Its meaning, with its values where these are not shares."""
        return self.meaning if self.is_numbers or self.unit == "1" else f"{self.meaning}; {self.range_in_words}"

    def shares(self, values: _Values) -> _Values:
        """The shares of its scale that amounts are, which 8 bits hold times 255; labels as they are."""
        low, high = self.scale
        if self.is_numbers or (low, high) == (0.0, 1.0):
            return values
        return (values.clip(low, high) - low) / (high - low)


OUTPUTS: dict[str, Output] = {}


def _register(name: str, meaning: str, **properties: Any) -> Output:
    properties.setdefault("planes", (name,))
    properties.setdefault("derive", lambda drawing: drawing.plane(name))
    OUTPUTS[name] = Output(name, meaning, **properties)
    return OUTPUTS[name]


def _labels(drawing: Drawing) -> Tensor:
    from ultragray.rendering.derived import render_labels  # needs torch

    return render_labels(drawing, WEIGHT_SUM)


def _attenuation(drawing: Drawing) -> Tensor:
    transmittance = drawing.plane("transmittance")
    above = transmittance.roll(1, dims=1)
    above[:, 0] = 1.0
    return (1.0 - transmittance / above.clamp(min=SPENT_BEAM)).clamp(0.0, 1.0) * (above >= SPENT_BEAM)


def _uncertainty(drawing: Drawing) -> Tensor:
    from ultragray.rendering.derived import deviations  # needs torch

    return deviations(drawing, UNCERTAINTY.planes)


def _bmode(drawing: Drawing) -> Tensor:
    return drawing.bmode()


BMODE = _register("bmode", "B = E T, what a scanner shows", derive=_bmode, is_toned=True)
ECHO = _register("echo", "E, the reflected intensity")
TRANSMITTANCE = _register("transmittance", "T, what is left of the beam at that depth")
COVERAGE = _register("coverage", "1 - exp(-S): how far Gaussians support the pixel", tells_support=True)
ATTENUATION = _register(
    "attenuation",
    "1 - T of the pixel alone: the share of the beam that reaches it and ends there; 0 where none does",
    planes=("transmittance",),
    derive=_attenuation,
)
LABELS = _register(
    "labels",
    "the label that weighs most, 0: none; of a scene with label_names, or of frames with tools",
    planes=(),
    derive=_labels,
    dtype=_NUMBERS,
    shows_tools_alone=True,
    lacks=lambda info: None if info.label_names else "whose Gaussians carry labels; this one's carry none",
)
UNCERTAINTY = _register(
    "uncertainty",
    "standard deviation that the error of bmode is expected to have; of a scene whose training fitted it",
    planes=("bmode", "coverage", "transmittance"),
    derive=_uncertainty,
    tells_support=True,
    lacks=lambda info: (
        None if info.confidence.get("uncertainty") else "whose training fitted its uncertainty; this one has none"
    ),
)


OUTPUT_SCHEMA: dict[str, Any] = {  # JSON Schema of the name of an output
    "type": "string",
    "oneOf": [
        {
            "const": output.name,
            "description": output.about,
            "x-numbers": output.is_numbers,
            "x-unit": output.unit,
            "x-scale": list(output.scale),
        }
        for output in OUTPUTS.values()
    ],
}


def check_outputs(outputs: Sequence[str]) -> tuple[str, ...]:
    """`outputs` without repetitions, in the given order. Raises UnknownOutput for an unknown name or an empty list."""
    names = (outputs,) if isinstance(outputs, str) else tuple(outputs)
    for name in names:
        if name not in OUTPUTS:
            raise UnknownOutput(f"outputs must be some of {', '.join(OUTPUTS)}, got {name!r}", field="outputs")
    if not names:
        raise UnknownOutput(f"outputs must name at least one of {', '.join(OUTPUTS)}, got none", field="outputs")
    return tuple(dict.fromkeys(names))


def check_available(outputs: Sequence[str], info: SceneInfo, *, with_tools: bool = False) -> None:
    for name in outputs:
        if with_tools and OUTPUTS[name].shows_tools_alone:
            continue
        if (lacking := OUTPUTS[name].lacks(info)) is not None:
            raise UnknownOutput(f"outputs may name {name} only for a scene {lacking}", field="outputs")

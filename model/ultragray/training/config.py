"""TrainingConfig: everything that decides how a scene is trained, in one typed object.

The same fields come from the command line, from a TOML file and from Python, and are stored in the scene. What follows
from the data (spacing of the frames, size of a pixel) is None unless it is set; fractions are of the whole run, so that
a run of any length keeps the shape of its schedules. Free of torch.
"""

from __future__ import annotations

import math
import sys
import typing
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from ..errors import InvalidArgument
from ..scene_info import INTENSITIES, MAX_SH_DEGREE

if typing.TYPE_CHECKING:
    from .geometry import Geometry

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

RELEASED_STEPS = 30_000  # the length of run that the released rates are tuned for
RELEASED_TRANSMITTANCE_RATE, MAX_SCALED_RATE = 5e-4, 2e-2
MAX_FLOOR = 0.9
MAX_RANGE_MM = 100.0  # frames further apart have nothing to say about what lies between
STARTS = ("informed", "random")
GROWTHS = ("even", "threshold")


@dataclass(frozen=True)
class TrainingConfig:
    """How to train. The defaults are the preset `fast`; `TrainingConfig.preset` gives the others.

    Rates are Adam's, for batches of one frame: the trainer multiplies them by √batch_size. Raises InvalidArgument,
    naming the field, for a value outside its range.
    """

    steps: int | None = None  # None: from the number of frames
    batch_size: int = 8  # frames of one step; fewer where the dataset has fewer
    seed: int = 0
    initial_gaussians: int | None = None  # None: max_gaussians, or half of them where refinements add to them
    max_gaussians: int | None = None  # None: from the number of pixels
    start: str = "informed"  # Gaussians begin on pixels of the frames; `random`: anywhere in a cube
    initial_scale_mm: float | None = None  # standard deviation; None: from the spacing of frames and pixels
    initial_elevation_mm: float | None = None  # the same along elevation, for an informed start
    initial_transmittance: float = 0.99
    intensity: str = "sigmoid"  # activation, docs/physics.md §2
    shadow_start: float = 0.1  # up to this share of the run only the transmittances are trained
    intensity_floor: float | None = None  # least intensity, up to floor_end; None: the frames' mean brightness
    floor_end: float = 0.3  # share of the run
    sh_degree: int = 1
    sh_start: float = 1_000 / RELEASED_STEPS  # where degree 1 joins; degree d at d times that
    transmittance: bool = True  # False: nothing absorbs
    out_of_plane_mm: float | None = None  # full range of the shift along elevation; None: from the frames; 0: off
    means_rate: float = 2e-4  # times the scene's scale, cm
    scales_rate: float = 1e-2
    quats_rate: float = 1e-2
    transmittance_rate: float | None = 5e-2  # None: 5e-4, and more in runs of less than 30,000 steps
    sh0_rate: float = 1e-2
    shn_rate: float = 2e-5
    final_rate: float = 0.1  # every rate decays exponentially to this share
    scale_penalty: float = 1e-3  # λ of λ·mean(exp(scales)), cm
    refinements: int = 0  # how often Gaussians are added and pruned
    refinement_end: float = 17_500 / RELEASED_STEPS  # the last refinement
    growth: str = "even"  # `threshold`: all above growth_gradient; `even`: the best, evenly up to max_gaussians
    growth_gradient: float = 5e-6  # mean ‖∂L/∂mean‖ of a Gaussian that is refined
    split_scale: float = 0.01  # × scene scale: above, a Gaussian is split, below, duplicated
    split_intensity: float = 1.0  # factor on sh0 of the halves
    prune_above: float = 0.1  # × scene scale, of the largest standard deviation
    prune_below: float = 1e-5
    confidence: bool = True  # a second, shorter training on a part of the frames fits the scene's confidence
    memory_gb: float | None = None  # None: what the machine has to give

    def __post_init__(self) -> None:
        hints = typing.get_type_hints(type(self))
        for item in fields(self):
            _check_type(item.name, getattr(self, item.name), hints[item.name])
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise InvalidArgument(f"{name} must be between {low:g} and {high:g}, got {value!r}", field=name)
        for name, choices in (("start", STARTS), ("intensity", INTENSITIES), ("growth", GROWTHS)):
            if getattr(self, name) not in choices:
                raise InvalidArgument(
                    f"{name} must be one of {', '.join(choices)}, got {getattr(self, name)!r}", field=name
                )
        if (self.initial_gaussians or 0) > (self.max_gaussians or math.inf):
            raise InvalidArgument(
                f"initial_gaussians must be at most max_gaussians ({self.max_gaussians}), got {self.initial_gaussians}",
                field="initial_gaussians",
            )

    @classmethod
    def preset(cls, name: str, **overrides: Any) -> TrainingConfig:
        """The preset `fast` or `paper` with some fields set otherwise.

        Raises InvalidArgument for an unknown preset or field.
        """
        if name not in PRESETS:
            raise InvalidArgument(f"preset must be one of {', '.join(PRESETS)}, got {name!r}", field="preset")
        values = {**PRESETS[name], **overrides}
        if "max_gaussians" in overrides and "initial_gaussians" not in overrides:
            values["initial_gaussians"] = None
        return cls.from_dict(values)

    def resolved(self, geometry: Geometry) -> TrainingConfig:
        """The same with everything that was left to the data filled in."""
        steps = self.steps or geometry.steps
        limit = self.max_gaussians or max(geometry.gaussian_count, self.initial_gaussians or 0)
        out_of_plane_mm = _given_or(self.out_of_plane_mm, geometry.out_of_plane_mm)
        return replace(
            self,
            steps=steps,
            max_gaussians=limit,
            initial_gaussians=self.initial_gaussians or (limit if not self.refinements else (limit + 1) // 2),
            initial_scale_mm=self.initial_scale_mm or geometry.initial_scale_mm,
            initial_elevation_mm=self.initial_elevation_mm or geometry.initial_elevation_mm(out_of_plane_mm),
            intensity_floor=_given_or(self.intensity_floor, min(geometry.brightness, MAX_FLOOR)),
            out_of_plane_mm=out_of_plane_mm,
            transmittance_rate=_given_or(self.transmittance_rate, scaled_transmittance_rate(steps)),
        )

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TrainingConfig:
        """Inverse of `to_dict`; what is left out keeps its default. Raises InvalidArgument, naming unknown keys."""
        known = [item.name for item in fields(cls)]
        unknown = sorted(set(values) - set(known))
        if unknown:
            raise InvalidArgument(
                f"a training has no setting {', '.join(unknown)}; it has {', '.join(known)}", field=unknown[0]
            )
        return cls(**values)

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


PRESETS: dict[str, dict[str, Any]] = {
    "fast": {},
    "paper": {
        "steps": RELEASED_STEPS,
        "initial_gaussians": 500_000,
        "max_gaussians": 500_000,
        "start": "random",
        "initial_scale_mm": 0.5,
        "intensity": "released",
        "shadow_start": 0.0,
        "intensity_floor": 0.0,
        "out_of_plane_mm": 2.0,
        "means_rate": 1e-4,
        "scales_rate": 5e-3,
        "quats_rate": 5e-3,
        "transmittance_rate": None,
        "sh0_rate": 5e-3,
        "shn_rate": 1e-5,
        "refinements": 7,
        "growth": "threshold",
        "split_intensity": 3.0,
    },
}

_RATES = ("means_rate", "scales_rate", "quats_rate", "transmittance_rate", "sh0_rate", "shn_rate")
_RANGES: dict[str, tuple[float, float]] = {
    "steps": (1, 10_000_000),
    "batch_size": (1, 1_024),
    "seed": (0, 2**63 - 1),
    "initial_gaussians": (1, 100_000_000),
    "max_gaussians": (1, 100_000_000),
    "initial_scale_mm": (1e-3, 1e3),
    "initial_transmittance": (0.5, 0.9999),
    "initial_elevation_mm": (1e-3, 1e3),
    "shadow_start": (0.0, 1.0),
    "intensity_floor": (0.0, MAX_FLOOR),
    "floor_end": (0.0, 1.0),
    "sh_degree": (0, MAX_SH_DEGREE),
    "sh_start": (0.0, 1.0),
    "out_of_plane_mm": (0.0, MAX_RANGE_MM),
    **dict.fromkeys(_RATES, (0.0, 1.0)),
    "final_rate": (1e-6, 1.0),
    "scale_penalty": (0.0, 100.0),
    "refinements": (0, 1_000),
    "refinement_end": (0.0, 1.0),
    "growth_gradient": (0.0, 1e6),
    "split_scale": (0.0, 10.0),
    "split_intensity": (-10.0, 10.0),
    "prune_above": (0.0, 100.0),
    "prune_below": (0.0, 1.0),
    "memory_gb": (1e-3, 1e6),
}


def scaled_transmittance_rate(steps: int) -> float:
    """The released rate for as many steps as it is meant for, in proportion more for fewer, so that shadows form."""
    return min(RELEASED_TRANSMITTANCE_RATE * max(1.0, RELEASED_STEPS / steps), MAX_SCALED_RATE)


def _given_or(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value


def _check_type(name: str, value: Any, hint: Any) -> None:
    kinds = typing.get_args(hint) or (hint,)
    allowed = {*kinds, int} if float in kinds else set(kinds)
    if type(value) not in allowed or (isinstance(value, float) and not math.isfinite(value)):
        words = {int: "an integer", float: "a finite number", str: "a word", bool: "true or false", type(None): "none"}
        expected = " or ".join(words[kind] for kind in kinds)
        raise InvalidArgument(f"{name} must be {expected}, got {value!r}", field=name)


def read_config_file(path: str | Path) -> dict[str, Any]:
    """The settings of a TOML file, by name; `preset` may be among them.

    Raises InvalidArgument, naming the file, where it is not TOML or holds a table; OSError where it cannot be read.
    """
    try:
        values = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InvalidArgument(f"{path}: not a TOML file: {error}", field="config") from error
    tables = [name for name, value in values.items() if isinstance(value, dict)]
    if tables:
        raise InvalidArgument(f"{path}: settings stand by themselves, not in a table [{tables[0]}]", field="config")
    return values


def parse_value(text: str) -> Any:
    """A value as TOML writes it; what is not TOML is a word."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text

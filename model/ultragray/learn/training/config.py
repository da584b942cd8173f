"""TrainingConfig: everything that decides how a scene is trained, in one typed object.

The same fields come from the command line, from a TOML file and from Python, and are stored in the scene. What follows
from the data (spacing of the frames, size of a pixel) is None unless it is set; fractions are of the whole run, so that
a run of any length keeps the shape of its schedules. Free of torch.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ultragray.contract import Contract, described
from ultragray.errors import InvalidArgument
from ultragray.geometry.probe import MAX_LENGTH_MM, MAX_THICKNESS_MM, MIN_DEPTH_OF_FIELD_MM, ElevationBeam
from ultragray.scene.info import INTENSITIES, MAX_SH_DEGREE

if TYPE_CHECKING:
    from ultragray.learn.training.geometry import Geometry


if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

RELEASED_STEPS = 30_000  # the length of run that the released rates are tuned for
RELEASED_TRANSMITTANCE_RATE, MAX_SCALED_RATE = 5e-4, 2e-2
USUAL_EFFORT = 1.0
VIEWS_BETWEEN = 0.5  # of a step; what is blended from two frames is thicker than a beam, and its shadows are wider
TEXTURE, TEXTURE_OF_LEARNED_BEAM = 0.05, 0.2  # with less a search that starts too thin ends too thick
MAX_RANGE_MM = 100.0  # frames further apart have nothing to say about what lies between
STARTS = ("informed", "random")
GROWTHS = ("even", "threshold")
REFINEMENTS = ("none", "path", "sweeps", "frames")


@dataclass(frozen=True)
class TrainingConfig(Contract):
    """Settings of a training. The defaults are the preset `fast`; `TrainingConfig.preset` gives the others.

    Rates are Adam's, for batches of one frame: the trainer multiplies them by √batch_size. Raises InvalidArgument,
    naming the field, for a value outside its range.
    """

    __topic__ = "Training"
    steps: int | None = described("Steps of the run; none: from the number of frames.", None, low=1, high=10_000_000)
    effort: float | None = described(
        "Factor on the steps and the Gaussians that follow from the data; none: chosen by trainings on a part of the "
        "frames, which are measured on the others.",
        USUAL_EFFORT,
        low=0.01,
        high=100.0,
    )
    batch_size: int = described("Views of one step; fewer where the dataset has few frames.", 8, low=1, high=1_024)
    views_between: float | None = described(
        "Share of them that lies between frames or beyond the ends of the sweep; none: 0.5, with a beam 0.",
        None,
        low=0.0,
        high=1.0,
    )
    seed: int = described("Of every random choice.", 0, low=0, high=2**63 - 1)
    initial_gaussians: int | None = described(
        "Gaussians at the start; none: max_gaussians, or half of them where refinements add to them.",
        None,
        low=1,
        high=100_000_000,
    )
    max_gaussians: int | None = described(
        "Gaussians at most; none: from the number of pixels.", None, low=1, high=100_000_000
    )
    start: str = described(
        "informed: Gaussians begin on pixels of the frames; random: anywhere in a cube.", "informed", choices=STARTS
    )
    initial_scale_mm: float | None = described(
        "Standard deviation at the start; none: from the spacing of frames and pixels.", None, low=1e-3, high=1e3
    )
    initial_elevation_mm: float | None = described(
        "The same along elevation, for an informed start.", None, low=1e-3, high=1e3
    )
    initial_transmittance: float = described("Of each Gaussian at the start.", 0.999, low=0.5, high=0.9999)
    intensity: str = described(
        "Activation of the echo intensity (docs/physics.md §2): released, or sigmoid, without its floor.",
        "sigmoid",
        choices=INTENSITIES,
    )
    intensity_floor: float = described(
        "Least intensity of what lies in a shadow, up to floor_end, as a share of what the whole beam would show.",
        0.9,
        low=0.0,
        high=1.0,
    )
    floor_end: float = described("Where the floor ends, as a share of the run.", 0.3, low=0.0, high=1.0)
    sh_degree: int = described("Degree of the spherical harmonics.", 1, low=0, high=MAX_SH_DEGREE)
    sh_start: float = described(
        "Where degree 1 joins, as a share of the run; degree d at d times that.",
        1_000 / RELEASED_STEPS,
        low=0.0,
        high=1.0,
    )
    transmittance: bool = described("Whether Gaussians absorb: without, there are no shadows.", True)
    out_of_plane_mm: float | None = described(
        "Full range of the shift of a batch along elevation; none: from the frames; 0: no shift.",
        None,
        low=0.0,
        high=MAX_RANGE_MM,
    )
    slice_thickness_mm: float | None = described(
        "Thickness of the frames along elevation (full width at half maximum, at the focus); none: planes, or learned.",
        None,
        above=0.0,
        high=MAX_THICKNESS_MM,
    )
    slice_focus_mm: float | None = described(
        "Depth of its focus below the face; none: the same thickness at every depth.", None, low=0.0, high=MAX_LENGTH_MM
    )
    slice_depth_of_field_mm: float | None = described(
        "Depth over which it is at most √2 times as thick as at the focus.",
        None,
        low=MIN_DEPTH_OF_FIELD_MM,
        high=MAX_LENGTH_MM,
    )
    learn_beam: bool = described(
        "Whether thickness, focus and depth of field are learned, from given ones on: for sweeps that cross or tilt.",
        False,
    )
    refine_poses: str = described(
        "Correction of the poses (docs/poses.md): none; path: that which neighbouring frames agree with; sweeps: each "
        "sweep as a whole; frames: all of it. Good poses are left alone.",
        "path",
        choices=REFINEMENTS,
    )
    means_rate: float = described("Learning rate of the means, times the scene's scale in cm.", 2e-4, low=0.0, high=1.0)
    scales_rate: float = described("Learning rate of the scales.", 1e-2, low=0.0, high=1.0)
    quats_rate: float = described("Learning rate of the quaternions.", 1e-2, low=0.0, high=1.0)
    transmittance_rate: float | None = described(
        "Learning rate of the transmittances; none: 5e-4, and more in runs of less than 30,000 steps.",
        0.4,
        low=0.0,
        high=1.0,
    )
    sh0_rate: float = described("Learning rate of the intensities.", 1e-2, low=0.0, high=1.0)
    shn_rate: float = described("Learning rate of the higher harmonics.", 3e-4, low=0.0, high=1.0)
    final_rate: float = described("Every rate decays exponentially to this share.", 0.1, low=1e-6, high=1.0)
    texture: float | None = described(
        "Share of structural dissimilarity in the loss, the rest is L1: less for the mean of what speckle may be and a "
        "better PSNR, more for its texture and a better MS-SSIM; none: 0.05, 0.2 where the beam is learned.",
        None,
        low=0.0,
        high=1.0,
    )
    absorption_penalty: float = described(
        "λ of λ·mean(1 − T) where frames show no shadow: by so much a pixel must gain from what absorbs above it.",
        3e-2,
        low=0.0,
        high=100.0,
    )
    scale_penalty: float = described("λ of λ·mean(exp(scales)), scales in cm.", 1e-3, low=0.0, high=100.0)
    refinements: int = described("How often Gaussians are added and pruned.", 0, low=0, high=1_000)
    refinement_end: float = described(
        "The last refinement, as a share of the run.", 17_500 / RELEASED_STEPS, low=0.0, high=1.0
    )
    growth: str = described(
        "threshold: all above growth_gradient are refined; even: the best, evenly up to max_gaussians.",
        "even",
        choices=GROWTHS,
    )
    growth_gradient: float = described("Mean ‖∂L/∂mean‖ of a Gaussian that is refined.", 5e-6, low=0.0, high=1e6)
    split_scale: float = described(
        "Times the scene's scale: above, a Gaussian is split, below, duplicated.", 0.01, low=0.0, high=10.0
    )
    split_intensity: float = described("Factor on sh0 of the halves.", 1.0, low=-10.0, high=10.0)
    prune_above: float = described(
        "Times the scene's scale: Gaussians with a larger standard deviation are pruned.", 0.1, low=0.0, high=100.0
    )
    prune_below: float = described(
        "Times the scene's scale: Gaussians whose largest standard deviation is smaller are pruned.",
        1e-5,
        low=0.0,
        high=1.0,
    )
    confidence: bool = described(
        "Whether a second, shorter training on a part of the frames fits the scene's confidence.", True
    )
    memory_gb: float | None = described(
        "Memory that the training may take, of what the machine has to give; none: all of it.", None, low=1e-3, high=1e6
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.initial_gaussians or 0) > (self.max_gaussians or math.inf):
            raise InvalidArgument(
                f"initial_gaussians must be at most max_gaussians ({self.max_gaussians}), got {self.initial_gaussians}",
                field="initial_gaussians",
            )
        shape = self.slice_focus_mm, self.slice_depth_of_field_mm
        if shape.count(None) == 1 or (self.slice_thickness_mm is None and shape != (None, None)):
            raise InvalidArgument(
                "slice_focus_mm and slice_depth_of_field_mm must be given together, and with slice_thickness_mm",
                field="slice_focus_mm",
            )

    @property
    def given_beam(self) -> ElevationBeam | None:
        if self.slice_thickness_mm is None:
            return None
        return ElevationBeam(self.slice_thickness_mm, self.slice_focus_mm, self.slice_depth_of_field_mm)

    @property
    def has_beam(self) -> bool:
        """Whether the scene gets a beam, given or learned."""
        return self.learn_beam or self.slice_thickness_mm is not None

    @classmethod
    def preset(cls, name: str, **overrides: Any) -> TrainingConfig:
        """One of PRESETS with some fields set otherwise.

        Raises InvalidArgument for an unknown preset or field.
        """
        if name not in PRESETS:
            raise InvalidArgument(f"preset must be one of {', '.join(PRESETS)}, got {name!r}", field="preset")
        values = {**PRESETS[name], **overrides}
        if "max_gaussians" in overrides and "initial_gaussians" not in overrides:
            values["initial_gaussians"] = None
        return cls.from_dict(values)

    def resolved(self, geometry: Geometry) -> TrainingConfig:
        """The same with everything that was left to the data filled in; an effort still open counts as 1."""
        views_between = _given_or(self.views_between, 0.0 if self.has_beam else VIEWS_BETWEEN)
        views_between = min(round(views_between * self.batch_size), self.batch_size - 1) / self.batch_size
        effort = _given_or(self.effort, USUAL_EFFORT)
        steps = self.steps or math.ceil(effort * geometry.steps(views_between))
        count = math.ceil(effort * geometry.gaussian_count(views_between))
        limit = self.max_gaussians or max(count, self.initial_gaussians or 0)
        shifted_mm = max(geometry.out_of_plane_mm, geometry.least_out_of_plane_mm(views_between))
        by_shifts = 0.0 if self.has_beam else min(shifted_mm, MAX_RANGE_MM)  # the beam takes their part
        out_of_plane_mm = _given_or(self.out_of_plane_mm, by_shifts)
        initial_scale_mm = self.initial_scale_mm or geometry.initial_scale_mm
        thick_mm = initial_scale_mm if self.has_beam else geometry.initial_elevation_mm(out_of_plane_mm)
        return replace(
            self,
            steps=steps,
            max_gaussians=limit,
            initial_gaussians=self.initial_gaussians or (limit if not self.refinements else (limit + 1) // 2),
            initial_scale_mm=initial_scale_mm,
            initial_elevation_mm=self.initial_elevation_mm or thick_mm,
            out_of_plane_mm=out_of_plane_mm,
            views_between=views_between,
            effort=effort,
            texture=_given_or(self.texture, TEXTURE_OF_LEARNED_BEAM if self.learn_beam else TEXTURE),
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
    "best": {"effort": None},
    "paper": {
        "steps": RELEASED_STEPS,
        "views_between": 0.0,
        "texture": 0.5,
        "initial_gaussians": 500_000,
        "max_gaussians": 500_000,
        "start": "random",
        "initial_scale_mm": 0.5,
        "intensity": "released",
        "initial_transmittance": 0.99,
        "intensity_floor": 0.0,
        "absorption_penalty": 0.0,
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


PRESET_MEANINGS = (
    "fast: minutes on two cores; best: fast, with the effort that frames left out ask for, in half an hour or more; "
    "paper: the released recipe."
)


def scaled_transmittance_rate(steps: int) -> float:
    """The released rate for as many steps as it is meant for, in proportion more for fewer, so that shadows form."""
    return min(RELEASED_TRANSMITTANCE_RATE * max(1.0, RELEASED_STEPS / steps), MAX_SCALED_RATE)


def _given_or(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value


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

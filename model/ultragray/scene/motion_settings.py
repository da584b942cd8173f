"""Settings of a mode of motion that a scene is to get, as the command line and jobs take them. Free of torch."""

from __future__ import annotations

from dataclasses import dataclass

from ultragray.contract import Contract, described
from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import MAX_POSITION_MM
from ultragray.scene.label_maps import VECTOR_AXES, VECTOR_FIELD_SUFFIXES
from ultragray.scene.modes import Motion
from ultragray.scene.shapes import LabelShape, OfFile, Shape, TubeShape

FIT_STEPS = 6000  # of the fit of a mode to a sweep
SPACING_MM, GIVEN_SPACING_MM = 15.0, 6.0  # between splines: of a field that is learned, of one that is given
AUTO = "auto"  # in the place of a surrogate: the numbers of the frames are found
FIELD_LEADS = ("from-rest", "to-rest")  # which way the vectors of a field lead
MAX_MOVED_MM = 100.0  # by what is built in
FIELD = "From a field of displacements"  # topic
_FORMATS = tuple(suffix.removeprefix(".") for suffix in VECTOR_FIELD_SUFFIXES)


@dataclass(frozen=True)
class FieldFile(OfFile, Contract):
    """A file with a vector in mm for each voxel, of a number of 1."""

    data: str = described("The file in base64.")
    format: str = described("Of the file.", "nii.gz", choices=_FORMATS)
    formats = _FORMATS


@dataclass(frozen=True, kw_only=True)
class MotionSettings(Contract):
    """A mode of motion that a scene is to get beside those that it has: learned from frames, or built in."""

    __topic__ = "Mode"

    name: str | None = described("Of the mode. Default: breathing; of a vessel: pulse.", None)
    chest_mm: float | None = described(
        "Built in: deep tissue goes so far from the skin and back.", None, low=-MAX_MOVED_MM, high=MAX_MOVED_MM
    )
    pulse_mm: float | None = described(
        "Built in: the wall of a vessel goes so far out, and tissue about it makes room.",
        None,
        low=-MAX_MOVED_MM,
        high=MAX_MOVED_MM,
    )
    vessel: Shape | None = described("The vessel that pulsates: a tube, or a label of the scene.", None)
    steps: int = described("Of the fit to frames.", FIT_STEPS, low=1, high=100_000)
    spacing_mm: float | None = described(
        f"Between splines of the field. Default: {SPACING_MM:g}; of a field that is given {GIVEN_SPACING_MM:g}; of a "
        "vessel half its radius, or what there is room for.",
        None,
        above=0.0,
        high=MAX_POSITION_MM,
    )
    field_leads: str | None = described(
        "from-rest: from a point of the tissue at rest to where it goes. to-rest: from a point of moved tissue to "
        "where it is at rest, as transforms of ITK and Slicer do that resample an image at rest.",
        None,
        choices=FIELD_LEADS,
        topic=FIELD,
    )
    field_axes: str | None = described(
        "Axes of the vectors where a NIfTI file does not say; ITK, ANTs and Slicer write lps.",
        None,
        choices=VECTOR_AXES,
        topic=FIELD,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.pulse_mm is None) != (self.vessel is None):
            raise InvalidArgument("pulse_mm and vessel belong together", field="vessel")
        if self.vessel is not None and not isinstance(self.vessel, (LabelShape, TubeShape)):
            raise InvalidArgument(f"vessel must be of the kind tube or label, got {self.vessel.kind}", field="vessel")

    def check_source(self, **others: bool) -> None:
        """Raises InvalidArgument unless the mode comes from one place: what is built in, or one of the others."""
        sources = {"chest_mm": self.chest_mm is not None, "pulse_mm": self.pulse_mm is not None, **others}
        if sum(sources.values()) != 1:
            names = ", ".join(name for name, is_given in sources.items() if is_given) or "none"
            raise InvalidArgument(f"a mode needs exactly one of {', '.join(sources)}, got {names}", field="chest_mm")

    def check_field(self, *, is_given: bool) -> None:
        """Raises InvalidArgument unless it is told of a field, and of nothing else, which way it leads."""
        if is_given != (self.field_leads is not None):
            raise InvalidArgument("field and field_leads belong together", field="field_leads")

    def mode_name(self, motion: Motion | None) -> str:
        """The name of the mode beside those of a scene. Raises InvalidArgument where one of them has it."""
        name = self.name or ("breathing" if self.vessel is None else "pulse")
        if motion is not None and name in (mode.name for mode in motion.modes):
            raise InvalidArgument(
                f"the scene has a mode that is called {name} already: give another name", field="name"
            )
        return name

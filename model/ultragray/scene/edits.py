"""Edits of scenes, as documents and requests name them; `ultragray.learn.editing` carries them out. Free of torch.

An edit makes a new scene. What it was made of, and by which edits, stands in its file as `provenance`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ultragray.contract import Contract, Family, described, from_dict, kind_field, to_dict, under
from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import MAX_POSITION_MM
from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import rotations_of, transforms_of
from ultragray.scene.shapes import Shape, point_field, read_document, turn_field
from ultragray.scene.tissues import TISSUES

MAX_EDITS = 100
MAX_LESIONS = 100
MADE_NAMES_BYTES = 100  # of a label's name


@dataclass(frozen=True)
class Edit(Family):
    """A change of a scene."""

    kind: str

    def recorded(self) -> dict[str, Any]:
        """The edit as a scene file tells it: of files their hash alone."""
        return {"kind": self.kind} | {
            one.name: _recorded(getattr(self, one.name))
            for one in fields(self)
            if one.name != "kind" and getattr(self, one.name) is not None
        }


def _recorded(value: Any) -> Any:
    if isinstance(value, Shape):
        return to_dict(value.recorded())
    return [_recorded(one) for one in value] if isinstance(value, tuple) else value


@dataclass(frozen=True, kw_only=True)
class Motion(Contract):
    """A rigid motion: a turn about a point, then a shift."""

    shift_mm: tuple[float, float, float] = point_field("Along the axes of the scene.", (0.0,) * 3)
    turn_deg: tuple[float, float, float] = turn_field()
    about_mm: tuple[float, float, float] = point_field("The point that the turn leaves where it is.", (0.0,) * 3)

    @property
    def motion(self) -> FloatArray:  # [4, 4] mm
        rotation, about = rotations_of(np.radians([self.turn_deg]))[0], np.asarray(self.about_mm)
        return transforms_of(rotation, about - rotation @ about + np.asarray(self.shift_mm))


@dataclass(frozen=True, kw_only=True)
class MoveEdit(Motion, Edit):
    """Moves the scene with its training poses and modes of motion, or a part of it alone, which counts as not recorded
    from then on.
    """

    shape: Shape | None = described("The part: Gaussians whose middle lies in it. Default: all, and the poses.", None)
    kind: Literal["move"] = kind_field("move")


@dataclass(frozen=True, kw_only=True)
class CutEdit(Edit):
    """Keeps the Gaussians whose middle lies inside a shape, or those outside. None is changed."""

    shape: Shape = described("Its surface divides the scene.")
    keep: str = described("Which side stays.", "inside", choices=("inside", "outside"))
    kind: Literal["cut"] = kind_field("cut")


@dataclass(frozen=True, kw_only=True)
class MergeEdit(Motion, Edit):
    """Adds the Gaussians and training poses of another scene, which the motion leads into this one.

    Which of the two shows at a place is decided by whose training images are nearer; where both are near, both show,
    each with half of its volume. Where neither was cut apart from the other, what was joined is then fitted to frames
    of both. Modes of motion are left out.
    """

    scene: str = described("Name of the other scene.")
    register: bool = described(
        "Whether the motion is only about right, and frames of the overlap find the rest.", False
    )
    match_gain: bool = described("Whether its echo is made as bright as that of this one in the overlap.", True)
    fit_steps: int = described(
        "Steps by which what was joined is fitted to frames of both at their training poses; 0: it stays as it is.",
        300,
        low=0,
        high=10_000,
    )
    seam_mm: float = described("Width of the passage from one to the other.", 1.0, low=0.01, high=100.0)
    kind: Literal["merge"] = kind_field("merge")


@dataclass(frozen=True, kw_only=True)
class Imaging(Contract):
    """The scanner that decibels become grey values by."""

    frequency_mhz: float = described("Of the sweep's probe.", 5.0, above=0.0, high=100.0)
    dynamic_range_db: float = described("Between black and white of the sweep's frames.", 60.0, low=10.0, high=200.0)


@dataclass(frozen=True, kw_only=True)
class InsertEdit(Imaging, Edit):
    """Puts a body of a tissue into the scene, in the place of what is there.

    Its Gaussians get a label of their own, and the scene file says that they were made. Tissue that attenuates less
    than soft tissue lets through what reaches it; it brightens nothing behind it.
    """

    shape: Shape = described("The body.")
    tissue: str = described("What it consists of.", "tumour", choices=tuple(TISSUES))
    label: str | None = described("Name of its label. Default: that of the tissue.", None)
    echo_db: float | None = described("Over the tissue around. Default: the tissue's.", None, low=-100.0, high=100.0)
    attenuation: float | None = described("One way, dB/(cm MHz). Default: the tissue's.", None, low=0.0, high=1000.0)
    texture_from_mm: tuple[float, float, float] | None = described(
        "Middle of the place of the scene whose texture it gets. Default: one is made, as rough as what is around.",
        None,
        low=-MAX_POSITION_MM,
        high=MAX_POSITION_MM,
    )
    wall_mm: float = described("Thickness of a bright wall around it, as a vessel has.", 0.0, low=0.0, high=20.0)
    seed: int = described("Of the texture.", 0, low=0, high=2**31 - 1)
    kind: Literal["insert"] = kind_field("insert")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.shape.has_surface:
            raise InvalidArgument(f"shape must be a body, got a {self.shape.kind}", field="shape")
        if not self.label_name or len(self.label_name) > MADE_NAMES_BYTES:
            raise InvalidArgument(f"label must have 1 to {MADE_NAMES_BYTES} characters", field="label")

    @property
    def label_name(self) -> str:
        return self.tissue if self.label is None else self.label


@dataclass(frozen=True, kw_only=True)
class LesionsEdit(Imaging, Edit):
    """Inserts bodies at random places that the training images show: training data with masks."""

    count: int = described("How many.", 1, low=1, high=MAX_LESIONS)
    tissues: tuple[str, ...] = described("Drawn from these.", ("cyst", "tumour", "calcification"))
    radius_min_mm: float = described("Of the smallest.", 2.0, low=0.5, high=100.0)
    radius_max_mm: float = described("Of the largest; calcifications have a third.", 6.0, low=0.5, high=100.0)
    seed: int = described("Of the random choices.", 0, low=0, high=2**31 - 1)
    kind: Literal["lesions"] = kind_field("lesions")

    def __post_init__(self) -> None:
        super().__post_init__()
        if unknown := set(self.tissues) - set(TISSUES):
            known = ", ".join(TISSUES)
            raise InvalidArgument(f"tissues must be some of {known}, got {sorted(unknown)[0]!r}", field="tissues")
        if not self.tissues or self.radius_max_mm < self.radius_min_mm:
            raise InvalidArgument("tissues must be one or more, and radius_max_mm no less than radius_min_mm")


@dataclass(frozen=True, kw_only=True)
class RelabelEdit(Edit):
    """Gives the Gaussians whose middle lies in one of some shapes a label: a box, a brush of spheres, a label map."""

    shapes: tuple[Shape, ...] = described("One or more.", most=10_000)
    label: str | None = described("Its name, known to the scene or new. Default: they lose theirs.", None)
    kind: Literal["relabel"] = kind_field("relabel")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.shapes or self.label == "":
            raise InvalidArgument("shapes must be one or more, and label no empty text", field="shapes")


@dataclass(frozen=True, kw_only=True)
class ThinEdit(Edit):
    """Leaves out the Gaussians that show least in frames at the training poses."""

    gaussian_count: int | None = described("How many stay.", None, low=1)
    file_bytes: int | None = described("Or: how large the scene file may be.", None, low=1)
    kind: Literal["thin"] = kind_field("thin")

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.gaussian_count is None) == (self.file_bytes is None):
            raise InvalidArgument("exactly one of gaussian_count and file_bytes must be given", field="gaussian_count")


def read_edits(path: str | Path) -> tuple[Edit, ...]:
    """The edits of a file: a JSON list, or a TOML file with tables [[edits]]. A shape's `file` is a path beside it.

    Raises InvalidArgument, naming the edit and its field.
    """
    return edits_of(read_document(Path(path), "edits"))


def edits_of(document: Any) -> tuple[Edit, ...]:
    """The edits of a list of them, or of an object with the list `edits`. Raises InvalidArgument."""
    if isinstance(document, Mapping):
        document = document.get("edits")
    if not isinstance(document, Sequence) or isinstance(document, str):
        raise InvalidArgument("edits must be a list", field="edits")
    edits = []
    for index, one in enumerate(document):
        with under(f"edits[{index}]"):
            edits.append(from_dict(Edit, one))
    return check_edits(tuple(edits))


def check_edits(edits: Sequence[Edit]) -> tuple[Edit, ...]:
    if not 1 <= len(edits) <= MAX_EDITS:
        raise InvalidArgument(f"edits must be 1 to {MAX_EDITS}, got {len(edits)}", field="edits")
    return tuple(edits)


def scenes_named(edits: Sequence[Edit]) -> tuple[str, ...]:
    """The other scenes that edits take from."""
    return tuple(dict.fromkeys(edit.scene for edit in edits if isinstance(edit, MergeEdit)))

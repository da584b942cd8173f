"""Recipes of scenes that nobody recorded: bodies of tissue, in a label map or as shapes, and the scan that sees them.

`ultragray.learn.synthesis` makes the scene. Free of torch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from ultragray.contract import Contract, described, from_dict, to_dict
from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import MAX_POSITION_MM
from ultragray.geometry.probe import ConvexProbe, Probe
from ultragray.scene.edits import MADE_NAMES_BYTES, Imaging
from ultragray.scene.info import MAX_LABEL, UNPAINTED
from ultragray.scene.shapes import MAP_FORMATS, MapShape, Shape, read_document
from ultragray.scene.tissues import SOFT_TISSUE_DB, TISSUES, Tissue

MAX_BODIES = 100
MAX_SCAN_POSES = 2_000
MAX_GAUSSIANS = 2_000_000
USUAL_PROBE = ConvexProbe(opening_angle_deg=60.0, near_mm=50.0, far_mm=170.0)


@dataclass(frozen=True, kw_only=True)
class TissueBody(Contract):
    """What a label of the map stands for, or a shape. A later one lies over those before it."""

    tissue: str = described("What it consists of.", choices=tuple(TISSUES))
    label: int | None = described("Its number in the label map.", None, low=1, high=MAX_LABEL)
    shape: Shape | None = described("Or where it is.", None)
    name: str | None = described("Of its label in the scene. Default: that of the tissue.", None)
    echo_db: float | None = described("Over liver. Default: the tissue's.", None, low=-100.0, high=100.0)
    attenuation: float | None = described("One way, dB/(cm MHz). Default: the tissue's.", None, low=0.0, high=1000.0)
    impedance: float | None = described("MRayl. Default: the tissue's.", None, above=0.0, high=100.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.label is None) == (self.shape is None):
            raise InvalidArgument("exactly one of label and shape must be given", field="label")
        if self.shape is not None and not self.shape.is_in_space:
            raise InvalidArgument(f"shape must be a part of space, got a {self.shape.kind}", field="shape")
        if not 1 <= len(self.label_name) <= MADE_NAMES_BYTES:
            raise InvalidArgument(f"name must have 1 to {MADE_NAMES_BYTES} characters", field="name")

    @property
    def label_name(self) -> str:
        return self.tissue if self.name is None else self.name

    @property
    def acoustics(self) -> Tissue:
        """Those of its tissue, but for what the body says otherwise."""
        overrides = {name: getattr(self, name) for name in ("echo_db", "attenuation", "impedance")}
        return replace(TISSUES[self.tissue], **{name: value for name, value in overrides.items() if value is not None})


@dataclass(frozen=True, kw_only=True)
class SceneRecipe(Imaging):
    """A scene from labels: bodies of tissue, and a sweep that looks at them.

    The scene's frame is that of the label map, mm, right-anterior-superior; without one, that of the shapes.
    """

    bodies: tuple[TissueBody, ...] = described("What is there. Nothing is where none is.", most=MAX_BODIES)
    label_map: str | None = described("A label map (NIfTI-1, NRRD) in base64.", None)
    label_map_format: str = described("Of that file.", "nii.gz", choices=MAP_FORMATS)
    ct: str | None = described(
        "A CT (NIfTI-1, NRRD; Hounsfield units) in base64: of what no body covers, its values tell gas, fat, soft "
        "tissue and bone, within the skin.",
        None,
    )
    ct_format: str = described("Of that file.", "nii.gz", choices=MAP_FORMATS)
    probe: Probe | None = described("That scans. Default: a convex one of 60°, 120 mm deep.", None)
    towards: tuple[float, float, float] = described("Direction of its beam.", (0.0, -1.0, 0.0), low=-1.0, high=1.0)
    along: tuple[float, float, float] = described(
        "Direction of the sweep, about at a right angle to that.", (0.0, 0.0, -1.0), low=-1.0, high=1.0
    )
    middle_mm: tuple[float, float, float] | None = described(
        "A point that the middle of the sweep looks at. Default: the middle of the bodies.",
        None,
        low=-MAX_POSITION_MM,
        high=MAX_POSITION_MM,
    )
    sweep_mm: float = described("Length of the sweep.", 80.0, low=0.0, high=1000.0)
    pose_count: int = described("Its frames.", 81, low=1, high=MAX_SCAN_POSES)
    image_size: int = described("Rows and scan lines of a frame.", 256, low=16, high=2048)
    level: float = described("Grey value of liver.", 0.35, low=0.05, high=0.95)
    compensated: float = described(
        "Attenuation, dB/(cm MHz), that the scanner's time-gain compensation takes out.", SOFT_TISSUE_DB, low=0.0
    )
    gaussian_count: int = described("About as many Gaussians.", 150_000, low=1_000, high=MAX_GAUSSIANS)
    seed: int = described("Of texture and speckle.", 0, low=0, high=2**31 - 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.bodies:
            raise InvalidArgument("bodies must be one or more", field="bodies")
        if len(set(self.names)) >= UNPAINTED:
            raise InvalidArgument(f"bodies must have fewer than {UNPAINTED} names", field="bodies")

    @property
    def scanner(self) -> Probe:
        return USUAL_PROBE if self.probe is None else self.probe

    @property
    def names(self) -> tuple[str, ...]:
        """Names of labels, in the order of their numbers from 1."""
        return tuple(dict.fromkeys(body.label_name for body in self.bodies))

    def recorded(self) -> dict[str, Any]:
        """The recipe as a scene file tells it: of files their hash alone."""
        document: dict[str, Any] = to_dict(self, with_none=False)
        for name in ("label_map", "ct"):
            if (data := getattr(self, name)) is not None:
                document[name] = _hash_of(data)
        for description, body in zip(document["bodies"], self.bodies, strict=True):
            if body.shape is not None:
                description["shape"] = to_dict(body.shape.recorded())
        return {"kind": "from_labels", **document}


def _hash_of(data: str) -> str:
    return "sha256:" + sha256(data.encode()).hexdigest()


def read_recipe(path: Path | None, label_map: Path | None, ct: Path | None = None, **others: Any) -> SceneRecipe:
    """The recipe of a TOML or JSON file, with the files of a label map and a CT, and other fields in place of its own.

    Raises InvalidArgument, naming the field; OSError.
    """
    document = {} if path is None else read_document(path, "tissue")
    if not isinstance(document, dict) or "bodies" not in document:
        raise InvalidArgument(f"{path or '--tissue'} must be a TOML or JSON file with a list of bodies", field="tissue")
    for name, file in (("label_map", label_map), ("ct", ct)):
        if file is not None:
            content = MapShape.of_file(file)
            document |= {name: content["data"], f"{name}_format": content["format"]}
    return replace(from_dict(SceneRecipe, document), **others)

"""The JSON of requests and answers."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, WithJsonSchema

from ultragray.display.settings import FRAME_RANGE_DB, Display
from ultragray.outputs import OUTPUTS
from ultragray.pose import quaternion_from_pose
from ultragray.probe import ConvexProbe, FloatArray, LinearProbe, PhasedProbe, Probe


class RequestModel(BaseModel):
    """Bodies are taken at their word: no coercion, no unknown keys, no NaN or infinity."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


class PositionBody(RequestModel):
    """A point in the scene frame, mm."""

    x: float
    y: float
    z: float


class QuaternionBody(RequestModel):
    """A rotation from the probe to the scene, unit norm within 1e-3."""

    w: float
    x: float
    y: float
    z: float


MatrixRow = Annotated[list[float], Field(min_length=4, max_length=4)]
MatrixRows = Annotated[list[MatrixRow], Field(min_length=4, max_length=4)]


class PoseBody(RequestModel):
    """A rigid probe-to-scene transform: `matrix` (4x4, mm), or `position_mm` and `quaternion`."""

    matrix: MatrixRows | None = None
    position_mm: PositionBody | None = None
    quaternion: QuaternionBody | None = None


class LinearProbeBody(RequestModel):
    """Parallel scan lines; 0 <= near_mm < far_mm."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"kind": "linear", "width_mm": 40.0, "near_mm": 0.0, "far_mm": 50.0}]}
    )

    kind: Literal["linear"]
    width_mm: float
    near_mm: float
    far_mm: float

    def probe(self) -> Probe:
        """Raises InvalidProbe."""
        return LinearProbe(width_mm=self.width_mm, near_mm=self.near_mm, far_mm=self.far_mm)


class ConvexProbeBody(RequestModel):
    """A fan of scan lines; near_mm is the radius of the face from the apex."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"kind": "convex", "opening_angle_deg": 60.0, "near_mm": 40.0, "far_mm": 90.0}]}
    )

    kind: Literal["convex"]
    opening_angle_deg: float
    near_mm: float
    far_mm: float

    def probe(self) -> Probe:
        """Raises InvalidProbe."""
        return ConvexProbe(opening_angle_deg=self.opening_angle_deg, near_mm=self.near_mm, far_mm=self.far_mm)


class PhasedProbeBody(RequestModel):
    """A fan of scan lines from the centre of the face."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"kind": "phased", "opening_angle_deg": 80.0, "far_mm": 50.0}]}
    )

    kind: Literal["phased"]
    opening_angle_deg: float
    far_mm: float

    def probe(self) -> Probe:
        """Raises InvalidProbe."""
        return PhasedProbe(opening_angle_deg=self.opening_angle_deg, far_mm=self.far_mm)


ProbeBody = Annotated[LinearProbeBody | ConvexProbeBody | PhasedProbeBody, Field(discriminator="kind")]


def probe_body(probe: Probe) -> LinearProbeBody | ConvexProbeBody | PhasedProbeBody:
    """The JSON of a probe."""
    if isinstance(probe, LinearProbe):
        return LinearProbeBody(kind="linear", width_mm=probe.width_mm, near_mm=probe.near_mm, far_mm=probe.far_mm)
    if isinstance(probe, PhasedProbe):
        return PhasedProbeBody(kind="phased", opening_angle_deg=probe.opening_angle_deg, far_mm=probe.far_mm)
    assert isinstance(probe, ConvexProbe)
    return ConvexProbeBody(
        kind="convex", opening_angle_deg=probe.opening_angle_deg, near_mm=probe.near_mm, far_mm=probe.far_mm
    )


class DisplayBody(RequestModel):
    """What a sonographer sets. The first three change B-mode only."""

    gain_db: float = Field(0.0, description="Added to every echo.")
    dynamic_range_db: float = Field(FRAME_RANGE_DB, description="From white down to black.")
    tgc_db: list[float] = Field(default=[], description="Gains at evenly spaced depths, linear in between.")
    depth_mm: float | None = Field(None, description="Deeper rows, counted from the face, are cut off.")
    flip: bool = Field(False, description="Left and right change places.")
    pixel_mm: float | None = Field(None, description="Scan conversion to square pixels of this size.")

    def display(self) -> Display:
        """Raises InvalidArgument."""
        return Display(**{**self.model_dump(), "tgc_db": tuple(self.tgc_db)})


class RenderBody(RequestModel):
    """What to render. Exactly one of `pose` and `poses`; all else has a default from the scene."""

    pose: PoseBody | None = Field(None, description="One pose; rendered before frames of `poses` that wait.")
    poses: list[PoseBody] | None = Field(None, description="Many poses, answered together, in order.")
    height: int | None = Field(None, description="Depth samples. Default: that of the training images, else 512.")
    width: int | None = Field(None, description="Scan lines. Default: that of the training images, else 512.")
    probe: ProbeBody | None = Field(None, description="Instead of the scene's own.")
    min_confidence: float | None = Field(None, description="0 to 1; what is below is refused, or masked.")
    below_min_confidence: Literal["refuse", "mask"] = Field(
        "refuse", description="mask: pixels of such frames that Gaussians do not support are 0."
    )
    display: DisplayBody | None = Field(None, description="Gain, depth, scan conversion ...; default: as rendered.")
    outputs: list[str] = Field(["bmode"], description="Some of bmode, echo, transmittance, coverage, labels.")
    dtype: Literal["uint8", "float32"] | None = Field(
        None,
        description="Of application/octet-stream; a dtype in the Accept header goes first. Default: uint8.",
    )
    timeout_ms: float | None = Field(
        None, gt=0, le=3_600_000, description="A frame that still waits after this time is dropped (504)."
    )


OutputName = Annotated[
    str,
    WithJsonSchema(
        {
            "type": "string",
            "oneOf": [
                {"const": output.name, "description": output.meaning, "x-numbers": output.is_numbers}
                for output in OUTPUTS.values()
            ],
        }
    ),
]


class PoseOut(BaseModel):
    """A pose in both forms."""

    matrix: list[list[float]]
    position_mm: PositionBody
    quaternion: QuaternionBody

    @classmethod
    def of(cls, pose: FloatArray) -> PoseOut:  # [4, 4]
        """The JSON of a pose in mm."""
        w, x, y, z = quaternion_from_pose(pose)
        return cls(
            matrix=pose.tolist(),
            position_mm=position_body(pose[:3, 3]),
            quaternion=QuaternionBody(w=w, x=x, y=y, z=z),
        )


def position_body(point: FloatArray | tuple[float, float, float]) -> PositionBody:
    """The JSON of a point [3] in mm."""
    x, y, z = (float(value) for value in point)
    return PositionBody(x=x, y=y, z=z)


class SceneError(BaseModel):
    """Why a scene file cannot be read."""

    reason: str
    detail: str


class SceneEntry(BaseModel):
    """A scene in the list. A file that cannot be read has `error`, and null for what is in the file."""

    name: str
    loaded: bool
    removable: bool = Field(description="Whether it may be deleted: scenes of the data folder may not.")
    gaussian_count: int | None = None
    image_height: int | None = None
    image_width: int | None = None
    file_bytes: int | None = None
    error: SceneError | None = None


class ScenePage(BaseModel):
    """One page of scenes by name."""

    scenes: list[SceneEntry]
    next_page_token: str = Field(description="Empty on the last page.")


class Bounds(BaseModel):
    """A box in the scene frame, mm."""

    min_mm: PositionBody
    max_mm: PositionBody


class TrainingPosesOut(BaseModel):
    """The poses that the scene has seen; frames far from them extrapolate."""

    count: int
    position_min_mm: PositionBody | None = None
    position_max_mm: PositionBody | None = None
    first: PoseOut | None = None
    middle: PoseOut | None = None
    last: PoseOut | None = None


class ConfidenceOut(BaseModel):
    """How well a scene knows the confidence of its frames."""

    error: float = Field(description="Mean absolute error of the confidence on the views it was fitted on.")
    fitted_on: int = Field(description="How many those are.")


class SceneOut(BaseModel):
    """All that a scene says about itself."""

    name: str
    loaded: bool
    loaded_processes: int
    file_bytes: int
    gaussian_count: int
    sh_degree: int
    intensity: str
    centre_mm: PositionBody
    bounds: Bounds = Field(description="Of the Gaussians' means.")
    probe: ProbeBody | None
    image_height: int | None
    image_width: int | None
    training_poses: TrainingPosesOut
    metrics: dict[str, float]
    dataset_name: str | None
    dataset_sha256: str | None
    outputs: list[OutputName] = Field(description="What can be rendered of it.")
    label_names: dict[int, str] = Field(description="What the values of the output labels mean; empty: it has none.")
    confidence: ConfidenceOut | None = Field(description="null: the scene cannot tell the confidence of its frames.")


class SceneLoaded(BaseModel):
    """What :load and :unload left behind."""

    scene: str
    loaded: bool
    loaded_processes: int


class Live(BaseModel):
    """The process runs."""

    status: Literal["live"] = "live"


class Ready(BaseModel):
    """Frames are rendered."""

    status: Literal["ready"] = "ready"

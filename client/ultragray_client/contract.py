# Generated from the dataclasses of ultragray by client/generate.py; change those.
"""The dataclasses that callers fill in, or get. The service checks the values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from dataclasses import field as field_of
from enum import Enum
from types import MappingProxyType
from typing import Any, Literal, TypeAlias

from .geometry import Picture, PoseLike

__all__ = [
    "MAX_AHEAD_MS",
    "PROBES",
    "Additions",
    "AroundSampler",
    "Below",
    "Box",
    "BoxShape",
    "Breathing",
    "ClockOffset",
    "CompareJob",
    "ComparisonSettings",
    "Contact",
    "ConvexProbe",
    "CoveredSampler",
    "CutEdit",
    "Cylinder",
    "Dataset",
    "DatasetOptions",
    "Display",
    "Edit",
    "ElevationBeam",
    "EllipsoidShape",
    "Encoding",
    "EvaluateJob",
    "Extrapolation",
    "FanSampler",
    "FieldFile",
    "FrameSettings",
    "ImageRegion",
    "Imaging",
    "InsertEdit",
    "LabelShape",
    "LesionsEdit",
    "LinearProbe",
    "LiveJob",
    "MapShape",
    "MergeEdit",
    "MeshShape",
    "Motion",
    "MotionJob",
    "MotionSettings",
    "MoveEdit",
    "Needle",
    "PhasedProbe",
    "PlanSettings",
    "Prediction",
    "Preview",
    "Probe",
    "RadialProbe",
    "RecordingSettings",
    "RecordingState",
    "RecordingView",
    "RelabelEdit",
    "RenderJob",
    "RenderSettings",
    "Sampler",
    "SceneRecipe",
    "SettingsUsed",
    "Shaft",
    "Shape",
    "SliceSettings",
    "Specification",
    "Speckle",
    "SphereShape",
    "SplineSampler",
    "SteeredProbe",
    "ThinEdit",
    "TissueBody",
    "Tool",
    "ToolFrame",
    "TrainJob",
    "TrainingSampler",
    "TubeShape",
    "VoxelizeJob",
]
MAX_AHEAD_MS = 1000.0  # that the service foretells a pose


@dataclass(frozen=True)
class ConvexProbe:
    """A curved array: scan lines fan out from the apex, which is the origin."""

    opening_angle_deg: float  # Full angle of the fan.
    near_mm: float  # Radius of the face: distance from the apex at which the image begins.
    far_mm: float  # Distance from the apex at which the image ends, beyond `near_mm`.
    kind: Literal["convex"] = field_of(default="convex", repr=False, kw_only=True)


@dataclass(frozen=True)
class LinearProbe:
    """A linear array: parallel scan lines along +z, the face centred on the origin."""

    width_mm: float  # Width of the face.
    near_mm: float  # Depth at which the image begins.
    far_mm: float  # Depth at which the image ends, beyond `near_mm`.
    kind: Literal["linear"] = field_of(default="linear", repr=False, kw_only=True)


@dataclass(frozen=True)
class PhasedProbe:
    """A phased array: scan lines fan out from the centre of the face; `near_mm` is 0."""

    opening_angle_deg: float  # Full angle of the fan.
    far_mm: float  # Depth at which the image ends.
    kind: Literal["phased"] = field_of(default="phased", repr=False, kw_only=True)


@dataclass(frozen=True)
class RadialProbe:
    """Scan lines all the way round in the image plane, outwards from a ring about the origin.

    Line j of W runs at the angle 360°·(j+½)/W from z towards +x; the last is followed by the first.
    """

    near_mm: float  # Radius of the ring: distance from the centre at which the image begins.
    far_mm: float  # Distance from the centre at which the image ends, beyond `near_mm`.
    kind: Literal["radial"] = field_of(default="radial", repr=False, kw_only=True)


@dataclass(frozen=True)
class SteeredProbe:
    """A linear array whose scan lines, parallel, leave the face at an angle; depths are along the lines."""

    width_mm: float  # Width of the face.
    steering_deg: float  # Angle of the scan lines from the axial axis, positive towards +x.
    near_mm: float  # Depth along the scan lines at which the image begins.
    far_mm: float  # Depth along the scan lines at which the image ends, beyond `near_mm`.
    kind: Literal["steered"] = field_of(default="steered", repr=False, kw_only=True)


Probe: TypeAlias = ConvexProbe | LinearProbe | PhasedProbe | RadialProbe | SteeredProbe
PROBES: Mapping[str, Probe] = MappingProxyType(
    {
        "C5-2": ConvexProbe(opening_angle_deg=70.0, near_mm=50.0, far_mm=200.0),
        "C9-4": ConvexProbe(opening_angle_deg=130.0, near_mm=11.0, far_mm=91.0),
        "L7-4": LinearProbe(width_mm=38.0, near_mm=0.0, far_mm=80.0),
        "L12-4": LinearProbe(width_mm=38.0, near_mm=0.0, far_mm=60.0),
        "L15-7": LinearProbe(width_mm=25.0, near_mm=0.0, far_mm=40.0),
        "P4-2": PhasedProbe(opening_angle_deg=90.0, far_mm=160.0),
    }
)


class Below(str, Enum):
    """The fate of a frame whose confidence is below the limit."""

    REFUSE = "refuse"
    MASK = "mask"


class Contact(str, Enum):
    """What a frame shows of the probe's contact with the skin (`ultragray.rendering.contact`)."""

    AIR = "air"
    PRESSURE = "pressure"


class ToolFrame(str, Enum):
    """The frame that the points of a tool are in."""

    SCENE = "scene"
    PROBE = "probe"


@dataclass(frozen=True, kw_only=True)
class Box:
    """A solid box about a point, turned about it."""

    kind: Literal["box"] = field_of(default="box", repr=False, kw_only=True)
    frame: ToolFrame = ToolFrame.SCENE  # Of its points; probe: it moves with the probe.
    brightness: float = 1.0  # Echo where a scan line meets it head on.
    roughness: float = 0.25  # Share of the brightness that is left at any angle.
    # Strength of the first echo of its comet tail, of which each further one has the same share; 0: no tail.
    reverberation: float = 0.4
    opacity: float = 0.6  # Share of the beam that it stops where it is met head on.
    label: int = 255  # Of its pixels in the output labels.
    centre_mm: tuple[float, float, float]  # x, y and z of its middle.
    # w, x, y and z of the rotation from the box to its frame.
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    size_mm: tuple[float, float, float]  # Lengths along its own x, y and z.


@dataclass(frozen=True, kw_only=True)
class Shaft:
    """A round shaft from its tip to its hub."""

    frame: ToolFrame = ToolFrame.SCENE  # Of its points; probe: it moves with the probe.
    brightness: float = 1.0  # Echo where a scan line meets it head on.
    roughness: float = 0.25  # Share of the brightness that is left at any angle.
    # Strength of the first echo of its comet tail, of which each further one has the same share; 0: no tail.
    reverberation: float = 0.4
    opacity: float = 0.6  # Share of the beam that it stops where it is met head on.
    label: int = 255  # Of its pixels in the output labels.
    tip_mm: tuple[float, float, float]  # x, y and z of the tip.
    hub_mm: tuple[float, float, float]  # x, y and z of the other end.
    diameter_mm: float = 0.7  # Diameter; 0.7 is 22 gauge.


@dataclass(frozen=True, kw_only=True)
class Cylinder(Shaft):
    """A solid cylinder with flat ends, thicker than the beam: its near side is seen. What is thinner is a needle."""

    kind: Literal["cylinder"] = field_of(default="cylinder", repr=False, kw_only=True)


@dataclass(frozen=True, kw_only=True)
class Needle(Shaft):
    """A straight needle. Its echo lies on the line from tip to hub, so that the tip is where it is said to be."""

    kind: Literal["needle"] = field_of(default="needle", repr=False, kw_only=True)


Tool: TypeAlias = Box | Cylinder | Needle


@dataclass(frozen=True)
class Breathing:
    """Regular breathing by the service's clock: the number of the first mode goes from end to end and back."""

    period_s: float = 4.0  # Of one breath.
    depth: float = 1.0  # Share of the range that was seen, from its low end.


class Speckle(str, Enum):
    """The speckle of a frame (`ultragray.rendering.speckle`)."""

    OFF = "off"
    NATURAL = "natural"


@dataclass(frozen=True)
class Display:
    """Settings of a display. The defaults show frames as they are.

    Gain, dynamic range, time-gain compensation and edge enhancement change B-mode only; the others change every output.
    """

    gain_db: float = 0.0  # Added to every echo.
    dynamic_range_db: float = 60.0  # From white down to black.
    # Gains at evenly spaced depths from the first row shown to the last, linear in between.
    tgc_db: tuple[float, ...] = ()
    depth_mm: float | None = None  # Deeper rows, counted from the face, are cut off.
    flip: bool = False  # Left and right change places.
    pixel_mm: float | None = None  # Scan conversion to square pixels of this size.
    edge: float = 0.0  # Edge enhancement: how much of what a blur over 3x3 samples takes away is added.
    # Two numbers between which the gain of each frame is drawn at random, instead of gain_db.
    gain_db_between: tuple[float, ...] = ()
    # Two numbers between which the dynamic range of each frame is drawn at random, instead of dynamic_range_db.
    dynamic_range_db_between: tuple[float, ...] = ()
    display_seed: int = 0  # Of what is drawn at random: the same seed and pose are the same frame, at every door.


@dataclass(frozen=True, kw_only=True)
class FrameSettings:
    """Settings of what is rendered, but for the scene and the poses. None: as the scene has it."""

    height: int | None = None  # Depth samples. Default: as trained, else 512.
    width: int | None = None  # Scan lines. Default: as trained, else 512.
    probe: Probe | None = None  # Instead of the scene's own.
    min_confidence: float | None = None  # What is below is refused, or masked.
    below_min_confidence: Below = Below.REFUSE  # mask: pixels of such frames that Gaussians do not support are 0.
    # Full width at half maximum along elevation at the focus of the scene's beam; 0: a plane. Default: as trained.
    slice_thickness_mm: float | None = None
    # air: scan lines whose face is off the skin are dark. pressure: and tissue gives way to a face that is pressed
    # in, and to needles. Default: contact is assumed.
    contact: Contact | None = None
    # How far the face is pressed in, with contact pressure. Default: as far as it lies beyond the skin of the
    # training views.
    indentation_mm: float | None = None
    tools: tuple[Tool, ...] | None = None  # Needles and the like in the image; labels then are there for every scene.
    # Second echo: share of what is heard beyond the first strong interface that is the mirror image of what lies
    # before it. Default: 0.
    ghost: float | None = None
    # Numbers of the scene's modes of motion, one each. Default: tissue is at rest.
    phase: tuple[float, ...] | None = None
    # The first mode breathes by the service's clock; frames tell the phase that they were drawn with.
    breathing: Breathing | None = None
    # natural: bmode has the speckle that scatterers in the tissue give a scanner's frames. Other outputs are as
    # without.
    speckle: Speckle = Speckle.OFF
    display: Display | None = None  # Gain, depth, scan conversion ...; default: as rendered.
    # Some of bmode, echo, transmittance, coverage, attenuation, labels, uncertainty.
    outputs: tuple[str, ...] = ("bmode",)


class Encoding(str, Enum):
    """The form that pixels come in."""

    UINT8 = "uint8"
    FLOAT32 = "float32"
    FLOAT16 = "float16"
    PNG = "png"
    JPEG = "jpeg"
    NPZ = "npz"


@dataclass(frozen=True, kw_only=True)
class RenderSettings(FrameSettings):
    """Settings with an encoding, for doors where neither an Accept header nor a file format decides it."""

    encoding: Encoding = Encoding.UINT8  # Form of the pixels.
    # Name of the registration by which the poses lead into the scene: they are then flange to base, or marker to
    # tracker. Default: they are probe to scene.
    registration: str | None = None


@dataclass(frozen=True, kw_only=True)
class Additions:
    """What a frame has only where it was asked for, as it was used."""

    min_confidence: float | None = None  # Below it the frame was refused, or masked; null: any.
    # mask: where the frame's confidence is below min_confidence, pixels without support are 0.
    below_min_confidence: Below = Below.REFUSE
    contact: Contact | None = None  # As used; null: it was assumed.
    indentation_mm: float | None = None  # As asked for; null: as the pose tells.
    tools: tuple[Tool, ...] = ()  # As used.
    ghost: float = 0.0  # As used; 0: none.
    phase: tuple[float, ...] = ()  # Numbers of the scene's modes of motion, as used; empty: at rest.
    speckle: Speckle = Speckle.OFF  # As used.
    registration: str | None = None  # That led the pose into the scene; null: none, it was sent as it is.


@dataclass(frozen=True, kw_only=True)
class SettingsUsed(Additions):
    """The settings of a frame, as used: with its scene and its pose all that is needed to render it again."""

    probe: Probe  # As used.
    slice_thickness_mm: float  # As used: at the focus of the scene's beam; 0: a plane.
    rendered_height: int  # Depth samples, before the display settings were applied.
    rendered_width: int  # Scan lines, likewise.
    display: Display = Display()  # As used.
    height: int  # H.
    width: int  # W.
    picture: Picture  # Where the pixels lie.
    outputs: tuple[str, ...]  # In the order of the data.
    encoding: Encoding  # Of the pixels.


@dataclass(frozen=True)
class Extrapolation:
    """Of one frame. None: the scene does not know its training views, has no model, or no coverage was given."""

    distance_mm: float | None  # Distance to the nearest training views, a mean over the image.
    angle_deg: float | None  # Angle to them.
    # The MS-SSIM that a real frame at this pose is expected to have with the rendered one, 0 to 1.
    confidence: float | None
    supported_share: float | None  # Share of the pixels that Gaussians support: coverage of at least 0.3.
    # Share of the scan lines that have contact with the skin; none where contact is assumed.
    contact_share: float | None = None
    # How far the face presses the tissue in, a mean over these lines; none without contact pressure. A frame with
    # more than 0 shows tissue as it was not recorded.
    indentation_mm: float | None = None
    force_n: float | None = None  # Force of the face on the tissue, along its axis; none likewise.


@dataclass(frozen=True)
class Prediction:
    """How far ahead of its measured pose a frame is, and how wrong its pose is expected to be (root mean square)."""

    ahead_ms: float  # From the time of the newest pose to that of the frame.
    error_mm: float | None  # Of the position; null: too few poses have come to tell.
    error_deg: float | None  # Of the rotation, likewise.


@dataclass(frozen=True)
class ClockOffset:
    """The client's clock beside the service's, as it is when the answer is sent."""

    offset_ms: float  # Client's time minus service's.
    # The offset is off by no more: half of the fastest round trip, and the standard deviation of the fit.
    uncertainty_ms: float
    drift_ppm: float  # What the client's clock gains, microseconds a second.


@dataclass(frozen=True)
class Preview:
    """What a frame of a stream that gets real frames shows, and how far to trust it."""

    real_age_ms: float  # From the newest real frame to the time of this one.
    moved_mm: float  # By the image since then, root mean square.
    is_real: bool  # It is the late real frame itself: that came nearer to the truth than what is rendered.
    # Root mean square of grey values from 0 to 1, as of the last real frames when they came; null: too few have.
    expected_error: float | None
    agreement: float  # Correlation of the structures of the newest real frame and the scene's, -1 to 1.
    trust: float | None  # Confidence times agreement, 0 to 1; null: the scene knows no confidence.
    offset_mm: float  # By which the scene was moved to where the real frames show it.
    offset_deg: float  # Likewise.
    disagrees: bool  # The newest real frame is not of the scene there, also after a search about its pose.


@dataclass(frozen=True, kw_only=True)
class SliceSettings:
    """A slice through a scene, on any plane: no probe is involved."""

    field: str = "echo"  # At each point. attenuation: per mm.
    origin_mm: tuple[float, float, float]  # Corner of the first pixel, in the scene's frame.
    right: tuple[float, float, float] = (1.0, 0.0, 0.0)  # Direction of the rows, of any length.
    down: tuple[float, float, float] = (0.0, 0.0, 1.0)  # Direction of the columns, at a right angle.
    size_mm: tuple[float, float]  # Width and height.
    spacing_mm: float = 0.5  # Distance of two pixels.


@dataclass(frozen=True, kw_only=True)
class PlanSettings:
    """Which views are looked for: what they shall gain, where, and which poses are in reach.

    Without a list of poses the probe's face stays on the skin that the recorded probe faces describe, looks straight in
    or is turned by up to `tilt_deg`, `rock_deg` and `turn_deg`, to either side each, about its lateral, elevation and
    axial axis.
    """

    probe: Probe | None = None  # That is to scan. Default: the scene's own.
    # What to gain. coverage: how near images come to the points, by within_mm. confidence: expected MS-SSIM of
    # frames that show them. uncertainty: of the variance of errors that views can take away, the share they do.
    want: str = "coverage"
    within_mm: float = 1.5  # Of coverage: a point so far from the nearest image counts half.
    # Only points of this box count, such as -20:20,0:30,-5:45. Default: all that poses in reach show.
    region_mm: str | None = None
    label: int | None = None  # Only points with this label count.
    # Only points of a plane count: its normal n, of any length, and the distance d, n·x = d |n|, mm.
    plane: tuple[float, float, float, float] | None = None
    views: int = 20  # How many at most.
    # How long the way may be at most, from view to view that of the corners of the image on average, so that a turn
    # counts by what it moves. Default: any length.
    path_mm: float | None = None
    box_mm: str | None = None  # The middle of the probe's face stays in this box. Default: anywhere.
    tilt_deg: float = 15.0  # About the lateral axis.
    rock_deg: float = 0.0  # About the elevation axis.
    turn_deg: float = 0.0  # About the axial axis.


@dataclass(frozen=True)
class ElevationBeam:
    """A Gaussian beam across the image plane, with a focus (docs/physics.md §3).

    Its thickness at a depth s is thickness_mm·√(1 + ((s − focus_mm)/z_R)²), its Rayleigh range z_R half the depth of
    field. With neither focus nor depth of field it is as thick at every depth.
    """

    thickness_mm: float  # Thickness at the focus: full width at half maximum along elevation.
    focus_mm: float | None = None  # Depth of the focus below the probe's face; none: the same thickness at every depth.
    # Depth over which it is at most √2 times as thick as at the focus: twice the Rayleigh range.
    depth_of_field_mm: float | None = None


@dataclass(frozen=True)
class DatasetOptions:
    """Options of reading a source. None leaves the choice to the source."""

    # Frames to train from, such as 0:90 or 0:90,100:120:2: places in the training file, or in the sequence.
    train_frames: str | None = None
    val_frames: str | None = None  # Frames to hold out, counted likewise.
    frames: str | None = None  # Frames of a sequence to read at all, such as 0:90,100:120:2.
    # Region of a sequence's image that shows ultrasound: columns,rows, such as 188:632,12:600 (ends left out).
    crop: str | None = None
    # Fan on the screen, of a recording with a convex or phased probe: opening angle (degrees), radius of the face
    # and of the end (mm), column and row of the apex, such as 60,40,90,319.5,-120.
    fan: str | None = None
    # Tracked transform of a sequence to take, such as ProbeToTracker, where there are several; of a recording two
    # frames of tf, such as probeTobase.
    transform: str | None = None
    image_size: str | None = None  # Resize the frames: WIDTHxHEIGHT, such as 192x256.
    image_topic: str | None = None  # Topic of a recording to take images from, where there are several.
    pose_topic: str | None = None  # Topic of a recording to take poses from; /tf: from the transforms of tf.
    # By how much images are stamped later than they were taken (negative: earlier): each gets the pose of that much
    # before its stamp.
    image_delay_ms: str | None = None


@dataclass(frozen=True)
class ImageRegion:
    """Where the frames of a sequence lie in its images, brought to columns lateral and rows in depth."""

    image_width: int  # Of the stored image, pixels.
    image_height: int  # Of the stored image, pixels.
    left: int  # Column of the stored image at which the frames begin.
    top: int  # Row at which they begin.
    width: int  # Of the frames in the stored image, pixels, before they are resized.
    height: int  # Likewise.
    lateral_mm: float  # Distance of two columns of the stored image.
    axial_mm: float  # Distance of two rows of the stored image.
    # The calibration, from pixels (column, row, 0) of the stored image to the probe's mm: 16 numbers row by row;
    # empty where the file has none of that name.
    image_to_probe: tuple[float, ...] = ()


@dataclass(frozen=True)
class Dataset:
    """An accepted dataset."""

    name: str  # Of letters, digits, '.', '_' and '-'.
    # Its format: released, a folder with conf.json and .npy files (or its conf.json); plus, a PLUS sequence (.mha,
    # .mhd, .nrrd, .nhdr); dicom, a DICOM cine loop (.dcm) with its poses beside it (.poses.npy or .poses.json);
    # mcap, an MCAP recording of ROS 2 (.mcap) with images and poses, its geometry in it or beside it
    # (.geometry.json); table, a folder of pictures with their poses.csv and calibration.json (or its poses.csv);
    # tusrec, a scan of TUS-REC (.h5) with its calibration (calib_matrix.csv, beside it or above).
    kind: str
    sha256: str  # Of images, poses, probe and split, however they were sent.
    bytes: int  # Of its files.
    created_at: str  # ISO 8601, UTC.
    train_frames: int  # Number of frames to train from.
    val_frames: int  # Number of frames held out.
    height: int  # Of a frame, pixels.
    width: int  # Of a frame, pixels.
    probe: Probe | None  # The probe that recorded it.
    warnings: tuple[str, ...]  # What looks wrong, for a person to decide.
    options: dict[str, str]  # How it was read: the query parameters of its upload.
    # Of a sequence: where its frames lie in the stored images, and its calibration; null where that is not known.
    region: ImageRegion | None = None
    owner: str | None = None  # Who uploaded it; null: nobody who is known.
    private: bool = False  # Whether others may not see it.


@dataclass(frozen=True)
class RecordingSettings:
    """What all frames of a recording have in common."""

    probe: Probe  # The probe that takes the frames.
    image_height: int  # Rows of a frame, along depth.
    image_width: int  # Columns of a frame, across scan lines.


@dataclass(frozen=True)
class RecordingState:
    """How far a recording is. What it tells is stored."""

    name: str  # Also of the dataset that it becomes.
    settings: RecordingSettings  # As it was begun.
    frames: int  # That are stored.
    next_number: int  # Least number that the next frame may have: those before it were stored, or are lost.
    bytes: int  # Of its blocks.
    created_at: str  # ISO 8601, UTC.


@dataclass(frozen=True)
class RecordingView(RecordingState):
    """How far a recording is. What it tells is stored."""

    owner: str | None = None  # Who records it; null: nobody who is known.
    private: bool = False  # Whether others may not see it.


@dataclass(frozen=True)
class ComparisonSettings:
    """Settings of a comparison."""

    # Methods to compare, some of scene, median, mean, maximum, median-0.25mm, mean-0.25mm, maximum-0.25mm, linear,
    # nearest, in-time, ultranerf-released, ultranerf-unit, ultranerf-mean, implicitvol, implicitvol-refined,
    # rapidvol, ultragauss, ultragauss-shadow; all: each of them.
    methods: tuple[str, ...] = ("all",)
    # equal: every method learns as long as the scene does with the preset fast on this machine; author: the steps
    # of each author's recipe, however long they take.
    budget: str = "equal"
    times: float = 1.0  # Factor on the equal time, for the methods other than the scene.
    seed: int = 0  # Of every random choice.


@dataclass(frozen=True, kw_only=True)
class CompareJob(ComparisonSettings):
    """Methods are fitted to a dataset, each within the same budget, and scored on its held-out frames.

    The means of each method are the metrics of the job, such as linear_psnr_db; comparison.html, comparison.json and
    comparison.tex have the rest.
    """

    kind: Literal["compare"] = field_of(default="compare", repr=False, kw_only=True)
    # Longest time that the job may run in all, s; then it fails, and a retry goes on. None: the service's longest.
    max_run_s: float | None = None
    # auto, cpu, cuda or cuda:N: what the worker must offer; auto: a GPU where it offers one, else its processor.
    device: str = "auto"
    min_memory_gb: int | None = None  # Least memory of the device, 10^9 bytes; of cpu: of the host.
    # Labels that the worker must have, such as {"site": "lab1"}.
    worker_labels: dict[str, str] = field_of(default_factory=dict)
    dataset: str  # Name of an uploaded dataset, with held-out frames.


@dataclass(frozen=True)
class EvaluateJob:
    """A scene is scored on the held-out frames of a dataset: PSNR, MS-SSIM, GMS and GMSD.

    At the poses of the dataset, and on the path that the scene was trained on. The means are the metrics of the job;
    evaluation.json has those of every frame.
    """

    dataset: str  # Name of an uploaded dataset, which need not be the one that the scene was trained from.
    scene: str  # Name of a scene.
    # Also score classical predictions from the training frames: compounding, and blends of neighbours.
    baselines: bool = False
    register: bool = False  # Also move each frame by one half of it, and score the other half: minutes.
    kind: Literal["evaluate"] = field_of(default="evaluate", repr=False, kw_only=True)
    # Longest time that the job may run in all, s; then it fails, and a retry goes on. None: the service's longest.
    max_run_s: float | None = field_of(default=None, kw_only=True)
    # auto, cpu, cuda or cuda:N: what the worker must offer; auto: a GPU where it offers one, else its processor.
    device: str = field_of(default="auto", kw_only=True)
    # Least memory of the device, 10^9 bytes; of cpu: of the host.
    min_memory_gb: int | None = field_of(default=None, kw_only=True)
    # Labels that the worker must have, such as {"site": "lab1"}.
    worker_labels: dict[str, str] = field_of(default_factory=dict, kw_only=True)


@dataclass(frozen=True)
class LiveJob:
    """A recording becomes a scene while its frames arrive, served in versions from the first frames on.

    When the recording is finished, it ends as a training of the preset `fast` does.
    """

    recording: str  # Name of a recording that is open; of a dataset: it is trained from as a whole.
    scene: str  # Name that the scene is served under, each version in the place of the one before.
    version_every_s: float = 1.0  # Least time between two versions, s.
    kind: Literal["live"] = field_of(default="live", repr=False, kw_only=True)
    # Longest time that the job may run in all, s; then it fails, and a retry goes on. None: the service's longest.
    max_run_s: float | None = field_of(default=None, kw_only=True)
    # auto, cpu, cuda or cuda:N: what the worker must offer; auto: a GPU where it offers one, else its processor.
    device: str = field_of(default="auto", kw_only=True)
    # Least memory of the device, 10^9 bytes; of cpu: of the host.
    min_memory_gb: int | None = field_of(default=None, kw_only=True)
    # Labels that the worker must have, such as {"site": "lab1"}.
    worker_labels: dict[str, str] = field_of(default_factory=dict, kw_only=True)


@dataclass(frozen=True)
class SphereShape:
    """A ball."""

    centre_mm: tuple[float, float, float]  # Its middle.
    radius_mm: float  # Its radius.
    kind: Literal["sphere"] = field_of(default="sphere", repr=False, kw_only=True)


@dataclass(frozen=True)
class EllipsoidShape:
    """An ellipsoid; its distance is exact to first order."""

    centre_mm: tuple[float, float, float]  # Its middle.
    radii_mm: tuple[float, float, float]  # Half its axes.
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)  # Axis times angle, degrees, about the axes of the scene.
    kind: Literal["ellipsoid"] = field_of(default="ellipsoid", repr=False, kw_only=True)


@dataclass(frozen=True)
class BoxShape:
    """A box along the axes of the scene."""

    min_mm: tuple[float, float, float]  # Its least corner.
    max_mm: tuple[float, float, float]  # Its greatest corner.
    kind: Literal["box"] = field_of(default="box", repr=False, kw_only=True)


@dataclass(frozen=True)
class TubeShape:
    """All that lies near a path of straight pieces, such as a vessel."""

    points_mm: tuple[tuple[float, float, float], ...]  # The path, two points or more.
    radius_mm: float  # Its radius.
    kind: Literal["tube"] = field_of(default="tube", repr=False, kw_only=True)


@dataclass(frozen=True)
class MeshShape:
    """The inside of a closed surface of triangles."""

    data: str  # A file of the mesh in base64, in mm of the scene's frame.
    format: str = "stl"  # Of the file.
    kind: Literal["mesh"] = field_of(default="mesh", repr=False, kw_only=True)


@dataclass(frozen=True)
class MapShape:
    """The voxels of a label in a label map. It can be cut out and relabelled, not inserted."""

    data: str  # A NIfTI-1 or NRRD file in base64, in mm of the scene's frame (RAS+).
    format: str = "nii.gz"  # Of the file.
    label: int = 0  # Of the voxels; 0: of all that have one.
    kind: Literal["map"] = field_of(default="map", repr=False, kw_only=True)


@dataclass(frozen=True)
class LabelShape:
    """The Gaussians of the scene that have a label. It can be cut out and relabelled, not inserted."""

    name: str  # Of the label, as the scene names it.
    kind: Literal["label"] = field_of(default="label", repr=False, kw_only=True)


Shape: TypeAlias = SphereShape | EllipsoidShape | BoxShape | TubeShape | MeshShape | MapShape | LabelShape


@dataclass(frozen=True, kw_only=True)
class MotionSettings:
    """A mode of motion that a scene is to get beside those that it has: learned from frames, or built in."""

    name: str | None = None  # Of the mode. Default: breathing; of a vessel: pulse.
    chest_mm: float | None = None  # Built in: deep tissue goes so far from the skin and back.
    pulse_mm: float | None = None  # Built in: the wall of a vessel goes so far out, and tissue about it makes room.
    vessel: Shape | None = None  # The vessel that pulsates: a tube, or a label of the scene.
    steps: int = 6000  # Of the fit to frames.
    # Between splines of the field. Default: 15; of a field that is given 6; of a vessel half its radius, or what
    # there is room for.
    spacing_mm: float | None = None
    # from-rest: from a point of the tissue at rest to where it goes. to-rest: from a point of moved tissue to where
    # it is at rest, as transforms of ITK and Slicer do that resample an image at rest.
    field_leads: str | None = None
    # Axes of the vectors where a NIfTI file does not say; ITK, ANTs and Slicer write lps.
    field_axes: str | None = None


@dataclass(frozen=True)
class FieldFile:
    """A file with a vector in mm for each voxel, of a number of 1."""

    data: str  # The file in base64.
    format: str = "nii.gz"  # Of the file.


@dataclass(frozen=True, kw_only=True)
class MotionJob(MotionSettings):
    """A scene gets a mode of motion: learned from the frames of a dataset, of a field of displacements, or built in.

    The scene itself stays as it is; the one that moves is served when the job has succeeded.
    """

    kind: Literal["motion"] = field_of(default="motion", repr=False, kw_only=True)
    # Longest time that the job may run in all, s; then it fails, and a retry goes on. None: the service's longest.
    max_run_s: float | None = None
    # auto, cpu, cuda or cuda:N: what the worker must offer; auto: a GPU where it offers one, else its processor.
    device: str = "auto"
    min_memory_gb: int | None = None  # Least memory of the device, 10^9 bytes; of cpu: of the host.
    # Labels that the worker must have, such as {"site": "lab1"}.
    worker_labels: dict[str, str] = field_of(default_factory=dict)
    scene: str  # Name of the scene, which was trained as if its tissue were still.
    into: str  # Name that the scene that moves will be served under.
    dataset: str | None = None  # Name of the dataset that the mode is learned from.
    # One for each frame of the recording, such as a belt's reading. Default: they are found in the frames.
    numbers: tuple[float, ...] | None = None
    field: FieldFile | None = None  # A file with a vector in mm for each voxel, of a number of 1.
    # Leads the frame of the file into the scene's: 4x4, rigid, mm, row by row. Default: they are the same.
    field_to_scene: tuple[float, ...] | None = None
    registration: str | None = None  # Name of the registration whose base_to_scene does so instead.


@dataclass(frozen=True)
class AroundSampler:
    """`count` of the base poses, drawn at random with repetition, each turned and shifted at random.

    It turns about a random axis through the probe's origin by a normal angle of standard deviation `rotation_deg`, and
    shifts by a normal step of standard deviation `translation_mm` along each axis.
    """

    count: int  # How many poses.
    translation_mm: float = 2.0  # Standard deviation along each axis.
    rotation_deg: float = 5.0  # Standard deviation of the angle.
    seed: int = 0  # Of the random choices.
    kind: Literal["around"] = field_of(default="around", repr=False, kw_only=True)


@dataclass(frozen=True)
class CoveredSampler:
    """`count` poses, uniform within the region that the base poses cover.

    How far apart two poses are is the mean distance of the corresponding corners of their image planes, mm, so that
    a turn counts by what it moves. The shortest links that join all base poses (a minimum spanning tree) say which are
    neighbours; links longer than 4 times their median are gaps between sweeps and not covered. A pose is drawn by its
    place on the links, uniform in their length: the blend of the two neighbours there (positions linear, orientations
    by slerp), shifted by a step that is uniform in the ball whose radius is the neighbours' distance in position, and
    turned about a random axis by an angle uniform up to the angle between them.
    """

    count: int  # How many poses.
    seed: int = 0  # Of the random choices.
    kind: Literal["covered"] = field_of(default="covered", repr=False, kw_only=True)


@dataclass(frozen=True)
class FanSampler:
    """The base poses, tilted by every multiple of `step_deg` from −`tilt_deg` to +`tilt_deg`: one sweep a tilt.

    The probe turns about its lateral axis x through the middle of its face, which stays where it is (linear: the
    origin; otherwise `near_mm` along the axial axis). A positive tilt turns the beam towards −y, as
    `freehand_poses(tilt_deg=…)` of the phantom does.
    """

    tilt_deg: float  # The largest tilt, to both sides.
    step_deg: float  # Between two tilts.
    kind: Literal["fan"] = field_of(default="fan", repr=False, kw_only=True)


@dataclass(frozen=True)
class SplineSampler:
    """Poses on a path through the base poses in their order: `count` of them, or one every `spacing_mm`.

    Positions lie on the natural cubic spline (continuous to its second derivative) over the length of the chords;
    orientations go from base pose to base pose on the shortest way at even speed (slerp). Both ends are base poses
    where `count` is above 1; with `spacing_mm` the last one is reached where the length allows it. Spacing is measured
    along the chords. Poses that repeat count once.
    """

    count: int | None = None  # How many poses.
    spacing_mm: float | None = None  # Instead of count: distance along the path.
    kind: Literal["spline"] = field_of(default="spline", repr=False, kw_only=True)


@dataclass(frozen=True, kw_only=True)
class TrainingSampler:
    """The training poses of the scene as they are, in order."""

    kind: Literal["training"] = field_of(default="training", repr=False, kw_only=True)


Sampler: TypeAlias = AroundSampler | CoveredSampler | FanSampler | SplineSampler | TrainingSampler


@dataclass(frozen=True)
class RenderJob(FrameSettings):
    """Many frames of a scene become one archive, or many, at `poses`, or at those that `sampler` makes.

    The sampler makes them of `poses`, or where none are given of the scene's training poses. Poses are kept as an array
    of exact ones: up to 100,000 of them would be millions of Python's objects. Where `below_min_confidence` is refuse,
    a sampler keeps to poses that have `min_confidence`, and `poses` without a sampler must all have it.
    """

    scene: str  # Name of a scene; NAME@SHA256, or NAME@ and 12 digits of it: with that content alone.
    poses: Iterable[PoseLike] | None = None  # 4x4 matrices, mm, probe to scene.
    sampler: Sampler | None = None  # Makes poses of the given ones, else of the scene's training poses.
    # tar: WebDataset; mcap: messages of ROS 2; dicom and plus (.igs.mha): bmode in uint8, true to scale. Default:
    # npz; in shards tar.
    format: str | None = None
    dtype: str | None = None  # Default: the format's own.
    # Frames of a file: the job becomes many files, which all workers make. Default: one file, above 100,000 frames
    # 5,000 in each.
    shard_frames: int | None = None
    # Name of the registration by which the poses lead into the scene: they are then flange to base, or marker to
    # tracker. Default: they are probe to scene.
    registration: str | None = None
    kind: Literal["render"] = field_of(default="render", repr=False, kw_only=True)
    # Longest time that the job may run in all, s; then it fails, and a retry goes on. None: the service's longest.
    max_run_s: float | None = field_of(default=None, kw_only=True)
    # auto, cpu, cuda or cuda:N: what the worker must offer; auto: a GPU where it offers one, else its processor.
    device: str = field_of(default="auto", kw_only=True)
    # Least memory of the device, 10^9 bytes; of cpu: of the host.
    min_memory_gb: int | None = field_of(default=None, kw_only=True)
    # Labels that the worker must have, such as {"site": "lab1"}.
    worker_labels: dict[str, str] = field_of(default_factory=dict, kw_only=True)


@dataclass(frozen=True)
class TrainJob:
    """A dataset becomes a scene that is served."""

    dataset: str  # Name of an uploaded dataset.
    scene: str  # Name that the scene will be served under.
    # fast: minutes on two cores; best: fast, with the effort that frames left out ask for, in half an hour or more;
    # paper: the released recipe.
    preset: str = "fast"
    settings: dict[str, Any] = field_of(default_factory=dict)  # Any training settings instead of the preset's.
    start_scene: str | None = None  # Name of a scene to begin with, such as one made from labels.
    kind: Literal["train"] = field_of(default="train", repr=False, kw_only=True)
    # Longest time that the job may run in all, s; then it fails, and a retry goes on. None: the service's longest.
    max_run_s: float | None = field_of(default=None, kw_only=True)
    # auto, cpu, cuda or cuda:N: what the worker must offer; auto: a GPU where it offers one, else its processor.
    device: str = field_of(default="auto", kw_only=True)
    # Least memory of the device, 10^9 bytes; of cpu: of the host.
    min_memory_gb: int | None = field_of(default=None, kw_only=True)
    # Labels that the worker must have, such as {"site": "lab1"}.
    worker_labels: dict[str, str] = field_of(default_factory=dict, kw_only=True)


@dataclass(frozen=True)
class VoxelizeJob:
    """A field of a scene becomes a volume, such as echo.nii.gz; no probe is involved.

    volume.json says where its voxels lie.
    """

    scene: str  # Name of a scene; NAME@SHA256, or NAME@ and 12 digits of it: with that content alone.
    field: str = "echo"  # At each point. attenuation: per mm.
    spacing_mm: float = 0.5  # Distance of two voxels along each axis.
    # Ranges of x, y and z in the scene's frame, such as -20:20,0:30,-5:45. Default: the bounds of the Gaussians.
    box_mm: str | None = None
    format: str = "nii.gz"  # Of the file.
    kind: Literal["voxelize"] = field_of(default="voxelize", repr=False, kw_only=True)
    # Longest time that the job may run in all, s; then it fails, and a retry goes on. None: the service's longest.
    max_run_s: float | None = field_of(default=None, kw_only=True)
    # auto, cpu, cuda or cuda:N: what the worker must offer; auto: a GPU where it offers one, else its processor.
    device: str = field_of(default="auto", kw_only=True)
    # Least memory of the device, 10^9 bytes; of cpu: of the host.
    min_memory_gb: int | None = field_of(default=None, kw_only=True)
    # Labels that the worker must have, such as {"site": "lab1"}.
    worker_labels: dict[str, str] = field_of(default_factory=dict, kw_only=True)


Specification: TypeAlias = CompareJob | EvaluateJob | LiveJob | MotionJob | RenderJob | TrainJob | VoxelizeJob


@dataclass(frozen=True, kw_only=True)
class Motion:
    """A rigid motion: a turn about a point, then a shift."""

    shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)  # Along the axes of the scene.
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)  # Axis times angle, degrees, about the axes of the scene.
    about_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)  # The point that the turn leaves where it is.


@dataclass(frozen=True, kw_only=True)
class MoveEdit(Motion):
    """Moves the scene with its training poses and modes of motion, or a part of it alone, which counts as not recorded
    from then on.
    """

    kind: Literal["move"] = field_of(default="move", repr=False, kw_only=True)
    shape: Shape | None = None  # The part: Gaussians whose middle lies in it. Default: all, and the poses.


@dataclass(frozen=True, kw_only=True)
class CutEdit:
    """Keeps the Gaussians whose middle lies inside a shape, or those outside. None is changed."""

    kind: Literal["cut"] = field_of(default="cut", repr=False, kw_only=True)
    shape: Shape  # Its surface divides the scene.
    keep: str = "inside"  # Which side stays.


@dataclass(frozen=True, kw_only=True)
class MergeEdit(Motion):
    """Adds the Gaussians and training poses of another scene, which the motion leads into this one.

    Which of the two shows at a place is decided by whose training images are nearer; where both are near, both show,
    each with half of its volume. Where neither was cut apart from the other, what was joined is then fitted to frames
    of both. Modes of motion are left out.
    """

    kind: Literal["merge"] = field_of(default="merge", repr=False, kw_only=True)
    scene: str  # Name of the other scene.
    register: bool = False  # Whether the motion is only about right, and frames of the overlap find the rest.
    match_gain: bool = True  # Whether its echo is made as bright as that of this one in the overlap.
    # Steps by which what was joined is fitted to frames of both at their training poses; 0: it stays as it is.
    fit_steps: int = 300
    seam_mm: float = 1.0  # Width of the passage from one to the other.


@dataclass(frozen=True, kw_only=True)
class Imaging:
    """The scanner that decibels become grey values by."""

    frequency_mhz: float = 5.0  # Of the sweep's probe.
    dynamic_range_db: float = 60.0  # Between black and white of the sweep's frames.


@dataclass(frozen=True, kw_only=True)
class InsertEdit(Imaging):
    """Puts a body of a tissue into the scene, in the place of what is there.

    Its Gaussians get a label of their own, and the scene file says that they were made. Tissue that attenuates less
    than soft tissue lets through what reaches it; it brightens nothing behind it.
    """

    kind: Literal["insert"] = field_of(default="insert", repr=False, kw_only=True)
    shape: Shape  # The body.
    tissue: str = "tumour"  # What it consists of.
    label: str | None = None  # Name of its label. Default: that of the tissue.
    echo_db: float | None = None  # Over the tissue around. Default: the tissue's.
    attenuation: float | None = None  # One way, dB/(cm MHz). Default: the tissue's.
    # Middle of the place of the scene whose texture it gets. Default: one is made, as rough as what is around.
    texture_from_mm: tuple[float, float, float] | None = None
    wall_mm: float = 0.0  # Thickness of a bright wall around it, as a vessel has.
    seed: int = 0  # Of the texture.


@dataclass(frozen=True, kw_only=True)
class LesionsEdit(Imaging):
    """Inserts bodies at random places that the training images show: training data with masks."""

    kind: Literal["lesions"] = field_of(default="lesions", repr=False, kw_only=True)
    count: int = 1  # How many.
    tissues: tuple[str, ...] = ("cyst", "tumour", "calcification")  # Drawn from these.
    radius_min_mm: float = 2.0  # Of the smallest.
    radius_max_mm: float = 6.0  # Of the largest; calcifications have a third.
    seed: int = 0  # Of the random choices.


@dataclass(frozen=True, kw_only=True)
class RelabelEdit:
    """Gives the Gaussians whose middle lies in one of some shapes a label: a box, a brush of spheres, a label map."""

    kind: Literal["relabel"] = field_of(default="relabel", repr=False, kw_only=True)
    shapes: tuple[Shape, ...]  # One or more.
    label: str | None = None  # Its name, known to the scene or new. Default: they lose theirs.


@dataclass(frozen=True, kw_only=True)
class ThinEdit:
    """Leaves out the Gaussians that show least in frames at the training poses."""

    kind: Literal["thin"] = field_of(default="thin", repr=False, kw_only=True)
    gaussian_count: int | None = None  # How many stay.
    file_bytes: int | None = None  # Or: how large the scene file may be.


Edit: TypeAlias = MoveEdit | CutEdit | MergeEdit | InsertEdit | LesionsEdit | RelabelEdit | ThinEdit


@dataclass(frozen=True, kw_only=True)
class TissueBody:
    """What a label of the map stands for, or a shape. A later one lies over those before it."""

    tissue: str  # What it consists of.
    label: int | None = None  # Its number in the label map.
    shape: Shape | None = None  # Or where it is.
    name: str | None = None  # Of its label in the scene. Default: that of the tissue.
    echo_db: float | None = None  # Over liver. Default: the tissue's.
    attenuation: float | None = None  # One way, dB/(cm MHz). Default: the tissue's.
    impedance: float | None = None  # MRayl. Default: the tissue's.


@dataclass(frozen=True, kw_only=True)
class SceneRecipe(Imaging):
    """A scene from labels: bodies of tissue, and a sweep that looks at them.

    The scene's frame is that of the label map, mm, right-anterior-superior; without one, that of the shapes.
    """

    bodies: tuple[TissueBody, ...]  # What is there. Nothing is where none is.
    label_map: str | None = None  # A label map (NIfTI-1, NRRD) in base64.
    label_map_format: str = "nii.gz"  # Of that file.
    # A CT (NIfTI-1, NRRD; Hounsfield units) in base64: of what no body covers, its values tell gas, fat, soft
    # tissue and bone, within the skin.
    ct: str | None = None
    ct_format: str = "nii.gz"  # Of that file.
    probe: Probe | None = None  # That scans. Default: a convex one of 60°, 120 mm deep.
    towards: tuple[float, float, float] = (0.0, -1.0, 0.0)  # Direction of its beam.
    along: tuple[float, float, float] = (0.0, 0.0, -1.0)  # Direction of the sweep, about at a right angle to that.
    # A point that the middle of the sweep looks at. Default: the middle of the bodies.
    middle_mm: tuple[float, float, float] | None = None
    sweep_mm: float = 80.0  # Length of the sweep.
    pose_count: int = 81  # Its frames.
    image_size: int = 256  # Rows and scan lines of a frame.
    level: float = 0.35  # Grey value of liver.
    compensated: float = 0.54  # Attenuation, dB/(cm MHz), that the scanner's time-gain compensation takes out.
    gaussian_count: int = 150000  # About as many Gaussians.
    seed: int = 0  # Of texture and speckle.

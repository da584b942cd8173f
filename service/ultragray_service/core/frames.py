"""A rendered frame, or slice, as all front doors tell it: what renders it again, and what it cost."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any

from pydantic import WithJsonSchema
from typing_extensions import Self

from ultragray.contract import described
from ultragray.geometry.probe import FloatArray, Picture, Probe
from ultragray.rendering.display import AS_RENDERED, Display
from ultragray.rendering.outputs import OUTPUTS
from ultragray.rendering.settings import Contact, Encoding, Resolved
from ultragray.rendering.tools import Tool
from ultragray.rendering.volumes import SliceView
from ultragray.scene.confidence import Extrapolation
from ultragray_service.core.poses import MatrixRows
from ultragray_workers.pool.messages import RenderResult

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


@dataclass(frozen=True, kw_only=True)
class FramePicture:
    """The place of the pixels of a frame: `first` is the centre of pixel (0, 0), `step` the way to the next one.

    Column and row: x and z in mm, or, where the columns are degrees, the angle from the z axis and the range in mm.
    """

    column_unit: str = described("mm or deg.", choices=("mm", "deg"))
    first: tuple[float, float]
    step: tuple[float, float]

    @classmethod
    def of(cls, picture: Picture) -> FramePicture:
        """The place of a picture, whose size stands beside it."""
        return cls(column_unit=picture.column_unit, first=picture.first, step=picture.step)

    @property
    def first_column(self) -> float:
        return self.first[0]

    @property
    def first_row_mm(self) -> float:
        return self.first[1]

    @property
    def column_step(self) -> float:
        return self.step[0]

    @property
    def row_step_mm(self) -> float:
        return self.step[1]


@dataclass(frozen=True, kw_only=True)
class SettingsUsed:
    """The settings of a frame, as used: the same for all frames of a stream."""

    probe: Probe = described("As used.")
    slice_thickness_mm: float = described("As used: at the focus of the scene's beam; 0: a plane.")
    contact: Contact | None = described("As used; none: it was assumed.", None)
    tools: tuple[Tool, ...] = described("As used.", ())
    ghost: float = described("As used; 0: none.", 0.0)
    registration: str | None = described("That led the pose into the scene; null: none, it was sent as it is.", None)
    rendered_height: int = described("Depth samples, before the display settings were applied.")
    rendered_width: int = described("Scan lines, likewise.")
    display: Display = described("As used.", AS_RENDERED)
    height: int = described("H.")
    width: int = described("W.")
    picture: FramePicture = described("Where the pixels lie.")
    outputs: tuple[OutputName, ...] = described("In the order of the data.")
    encoding: Encoding = described("Of the pixels.")


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameFacts:
    """The facts of one frame beside its settings: its origin, its pose, and what it cost."""

    scene: str = described("Name.")
    scene_sha256: str = described("Of the scene file.")
    renderer: str = described("Name, version and backend of the renderer.")
    pose: MatrixRows = described("Matrix as used.")
    extrapolation: Extrapolation = described("How far the frame lies from the training views.")
    queue_ms: float = described("Waiting time.")
    render_ms: float = described("Of the batch that it was rendered in.")
    encode_ms: float = described("Encoding time.")

    @classmethod
    def of(cls, result: RenderResult, **others: Any) -> Self:
        """The facts of a result of one pose; `others` are what else the class has."""
        return cls(
            scene=result.scene,
            scene_sha256=result.scene_sha256,
            renderer=result.renderer,
            pose=result.poses[0].tolist(),
            extrapolation=result.extrapolations[0],
            queue_ms=round(result.queue_ms, 3),
            render_ms=round(result.render_ms, 3),
            encode_ms=round(result.encode_ms, 3),
            **others,
        )

    @property
    def timings(self) -> FrameFacts:
        """Itself: gRPC has the three times in a message of their own."""
        return self


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameHeader(SettingsUsed, FrameFacts):
    """All that is needed to render a frame again, and what it cost."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SliceFacts:
    """A slice but for its pixels."""

    scene: str
    scene_sha256: str
    field: str
    height: int
    width: int
    encoding: Encoding
    pixel_to_scene: FloatArray  # [4, 4] mm
    queue_ms: float
    render_ms: float
    encode_ms: float

    @classmethod
    def of(cls, result: RenderResult[SliceView]) -> SliceFacts:
        """The facts of a result of one slice."""
        view = result.settings
        return cls(
            scene=result.scene,
            scene_sha256=result.scene_sha256,
            field=view.field,
            height=view.height,
            width=view.width,
            encoding=view.encoding,
            pixel_to_scene=view.grid(result.poses[0]).affine,
            queue_ms=round(result.queue_ms, 3),
            render_ms=round(result.render_ms, 3),
            encode_ms=round(result.encode_ms, 3),
        )

    @property
    def timings(self) -> SliceFacts:
        """Itself: gRPC has the three times in a message of their own."""
        return self


@lru_cache(maxsize=256)
def settings_used(settings: Resolved) -> SettingsUsed:
    """The settings of a request, as frames tell them."""
    return SettingsUsed(
        probe=settings.probe,
        slice_thickness_mm=settings.beam.thickness_mm,
        contact=settings.contact,
        tools=settings.tools,
        ghost=settings.ghost,
        registration=settings.registration,
        rendered_height=settings.height,
        rendered_width=settings.width,
        display=settings.display,
        height=settings.picture.height,
        width=settings.picture.width,
        picture=FramePicture.of(settings.picture),
        outputs=settings.outputs,
        encoding=settings.encoding,
    )

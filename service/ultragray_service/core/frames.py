"""A rendered frame, or slice, as all front doors tell it: what renders it again, and what it cost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from typing_extensions import Self

from ultragray.contract import described
from ultragray.geometry.probe import FloatArray
from ultragray.rendering.settings import Encoding, SettingsUsed
from ultragray.rendering.volumes import SliceView
from ultragray.scene.confidence import Extrapolation
from ultragray_service.core.poses import MatrixRows
from ultragray_workers.pool.messages import RenderResult


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

"""Between the messages of the wire and the values of the library."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict

import numpy as np

from ultragray.contract import under
from ultragray.display.settings import AS_RENDERED, FRAME_RANGE_DB, Display
from ultragray.errors import InvalidArgument, InvalidPose, InvalidProbe, UltragrayError, UnknownOutput
from ultragray.pose import check_poses, pose_from_position_quaternion
from ultragray.probe import ConvexProbe, FloatArray, LinearProbe, PhasedProbe, Picture, Probe
from ultragray.settings import Below, Encoding, RenderSettings
from ultragray_proto.v1 import geometry_pb2, rendering_pb2, scenes_pb2
from ultragray_workers.pool.types import RenderResult

from ..core.requests import one_pose

OUTPUT_NAMES = {
    rendering_pb2.OUTPUT_BMODE: "bmode",
    rendering_pb2.OUTPUT_ECHO: "echo",
    rendering_pb2.OUTPUT_TRANSMITTANCE: "transmittance",
    rendering_pb2.OUTPUT_COVERAGE: "coverage",
    rendering_pb2.OUTPUT_LABELS: "labels",
}
OUTPUT_NUMBERS = {name: number for number, name in OUTPUT_NAMES.items()}

ENCODINGS = {
    rendering_pb2.ENCODING_UNSPECIFIED: Encoding.UINT8,
    rendering_pb2.ENCODING_UINT8: Encoding.UINT8,
    rendering_pb2.ENCODING_FLOAT32: Encoding.FLOAT32,
    rendering_pb2.ENCODING_PNG: Encoding.PNG,
    rendering_pb2.ENCODING_JPEG: Encoding.JPEG,
}
_ENCODING_NUMBERS = {
    encoding: number for number, encoding in ENCODINGS.items() if number != rendering_pb2.ENCODING_UNSPECIFIED
}


_BELOW = {
    rendering_pb2.BELOW_CONFIDENCE_UNSPECIFIED: Below.REFUSE,
    rendering_pb2.BELOW_CONFIDENCE_REFUSE: Below.REFUSE,
    rendering_pb2.BELOW_CONFIDENCE_MASK: Below.MASK,
}


def pose_from_message(message: geometry_pb2.Pose, field: str) -> FloatArray:  # [4, 4] mm
    """The exact pose. Raises InvalidPose, naming the part of `field` to blame."""
    form = message.WhichOneof("form")
    if form == "matrix":
        values = message.matrix.values
        if len(values) != 16:
            raise InvalidPose(
                f"{field}.matrix.values must hold 16 numbers, row by row, got {len(values)}",
                field=f"{field}.matrix.values",
            )
        return one_pose(np.array(values).reshape(4, 4), field=f"{field}.matrix")
    if form != "placement":
        raise InvalidPose(f"{field} must hold matrix or placement", field=field)
    placement = message.placement
    for part in ("position_mm", "quaternion"):
        if not placement.HasField(part):
            raise InvalidPose(f"{field}.placement.{part} is required", field=f"{field}.placement.{part}")
    p, q = placement.position_mm, placement.quaternion
    return pose_from_position_quaternion((p.x, p.y, p.z), (q.w, q.x, q.y, q.z), field=f"{field}.placement")


def poses_from_messages(messages: Sequence[geometry_pb2.Pose], field: str) -> FloatArray:  # [C, 4, 4] mm
    """The exact poses; many of them, as matrices, at once. Raises InvalidPose, naming the part of `field` to blame."""
    if all(pose.WhichOneof("form") == "matrix" and len(pose.matrix.values) == 16 for pose in messages):
        matrices = np.empty((len(messages), 16))
        for index, pose in enumerate(messages):
            matrices[index] = pose.matrix.values
        with suppress(InvalidPose):  # told below
            return check_poses(matrices.reshape(-1, 4, 4))
    return np.stack([pose_from_message(pose, f"{field}[{index}]") for index, pose in enumerate(messages)])


def probe_from_message(message: geometry_pb2.Probe) -> Probe:
    """Raises InvalidProbe; its field is a path below the probe."""
    kind = message.WhichOneof("kind")
    if kind == "linear":
        linear = message.linear
        with under("linear"):
            return LinearProbe(width_mm=linear.width_mm, near_mm=linear.near_mm, far_mm=linear.far_mm)
    if kind == "convex":
        convex = message.convex
        with under("convex"):
            return ConvexProbe(opening_angle_deg=convex.opening_angle_deg, near_mm=convex.near_mm, far_mm=convex.far_mm)
    if kind == "phased":
        with under("phased"):
            return PhasedProbe(opening_angle_deg=message.phased.opening_angle_deg, far_mm=message.phased.far_mm)
    raise InvalidProbe("kind must be linear, convex or phased, got none", field="kind")


def probe_message(probe: Probe) -> geometry_pb2.Probe:
    """The message of a probe."""
    if isinstance(probe, LinearProbe):
        linear = geometry_pb2.LinearProbe(width_mm=probe.width_mm, near_mm=probe.near_mm, far_mm=probe.far_mm)
        return geometry_pb2.Probe(linear=linear)
    if isinstance(probe, PhasedProbe):
        phased = geometry_pb2.PhasedProbe(opening_angle_deg=probe.opening_angle_deg, far_mm=probe.far_mm)
        return geometry_pb2.Probe(phased=phased)
    assert isinstance(probe, ConvexProbe)
    convex = geometry_pb2.ConvexProbe(
        opening_angle_deg=probe.opening_angle_deg, near_mm=probe.near_mm, far_mm=probe.far_mm
    )
    return geometry_pb2.Probe(convex=convex)


def matrix_message(pose: FloatArray) -> geometry_pb2.Matrix:  # [4, 4]
    """The message of a pose in mm."""
    return geometry_pb2.Matrix(values=pose.ravel().tolist())


def position_message(point: FloatArray | tuple[float, float, float]) -> geometry_pb2.Position:
    """The message of a point [3] in mm."""
    x, y, z = (float(value) for value in point)
    return geometry_pb2.Position(x=x, y=y, z=z)


def settings_from_message(message: rendering_pb2.RenderSettings) -> RenderSettings:
    """What the settings ask for. Raises InvalidArgument; its field is a path below the settings."""
    if message.encoding not in ENCODINGS:
        raise InvalidArgument(f"encoding must be one of the enum Encoding, got {message.encoding}", field="encoding")
    outputs = tuple(output_name(number) for number in message.outputs)
    probe = None
    if message.HasField("probe"):
        with under("probe"):
            probe = probe_from_message(message.probe)
    display = None
    if message.HasField("display"):
        with under("display"):
            display = display_from_message(message.display)
    return RenderSettings(
        probe=probe,
        height=message.height if message.HasField("height") else None,
        width=message.width if message.HasField("width") else None,
        outputs=outputs or ("bmode",),
        encoding=ENCODINGS[message.encoding],
        display=display,
        min_confidence=message.min_confidence if message.HasField("min_confidence") else None,
        below_min_confidence=_below(message.below_min_confidence),
    )


def _below(number: rendering_pb2.BelowConfidence) -> Below:
    if number not in _BELOW:
        raise InvalidArgument(
            f"below_min_confidence must be one of the enum BelowConfidence, got {number}", field="below_min_confidence"
        )
    return _BELOW[number]


def display_from_message(message: rendering_pb2.Display) -> Display:
    """Raises InvalidArgument; its field is a path below the display."""
    return Display(
        gain_db=message.gain_db,
        dynamic_range_db=message.dynamic_range_db if message.HasField("dynamic_range_db") else FRAME_RANGE_DB,
        tgc_db=tuple(message.tgc_db),
        depth_mm=message.depth_mm if message.HasField("depth_mm") else None,
        flip=message.flip,
        pixel_mm=message.pixel_mm if message.HasField("pixel_mm") else None,
    )


def display_message(display: Display) -> rendering_pb2.Display | None:
    """The message of display settings; None where they change nothing."""
    return None if display == AS_RENDERED else rendering_pb2.Display(**asdict(display))


def picture_message(picture: Picture) -> rendering_pb2.Picture:
    """Where the pixels of a frame lie."""
    return rendering_pb2.Picture(
        column_unit=picture.column_unit,
        first_column=picture.first[0],
        first_row_mm=picture.first[1],
        column_step=picture.step[0],
        row_step_mm=picture.step[1],
    )


def output_name(number: rendering_pb2.Output) -> str:
    """The name of an output. Raises UnknownOutput."""
    if number not in OUTPUT_NAMES:
        names = ", ".join(rendering_pb2.Output.Name(known) for known in OUTPUT_NAMES)
        raise UnknownOutput(f"outputs must be some of {names}, got number {number}", field="outputs")
    return OUTPUT_NAMES[number]


def frame_message(result: RenderResult, sequence: int) -> rendering_pb2.Frame:
    """The frame of a result of one pose."""
    return rendering_pb2.Frame(
        sequence=sequence,
        scene=result.scene,
        scene_sha256=result.scene_sha256,
        renderer=result.renderer,
        pose=matrix_message(result.poses[0]),
        probe=probe_message(result.settings.probe),
        height=result.height,
        width=result.width,
        outputs=[OUTPUT_NUMBERS[name] for name in result.settings.outputs],
        encoding=_ENCODING_NUMBERS[result.settings.encoding],
        data=result.data,
        extrapolation=rendering_pb2.Extrapolation(**asdict(result.extrapolations[0])),
        display=display_message(result.settings.display),
        picture=picture_message(result.settings.picture),
        rendered_height=result.settings.height,
        rendered_width=result.settings.width,
        timings=rendering_pb2.Timings(queue_ms=result.queue_ms, render_ms=result.render_ms, encode_ms=result.encode_ms),
    )


def error_message(error: UltragrayError) -> scenes_pb2.Error:
    """The three facts of an error."""
    return scenes_pb2.Error(reason=error.reason, field=error.field or "", detail=error.detail)

"""Bodies of requests, read as the classes of the contract: JSON small and large, and the files of a form."""

from __future__ import annotations

import asyncio
import json
import math
import re
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import Field, dataclass, field, make_dataclass, replace
from functools import cache, partial
from itertools import pairwise
from typing import Any, Literal, TypeVar, get_args

import numpy as np
from pydantic import TypeAdapter, ValidationError
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.requests import Request

from ultragray.contract import Contract, annotated_fields, described, error_under
from ultragray.errors import InvalidArgument, InvalidImageSize, InvalidPose, UltragrayError
from ultragray.exchange.exports.exporter import Annotation
from ultragray.geometry.image_size import MAX_IMAGE_SIDE
from ultragray.geometry.motion import MAX_AHEAD_MS
from ultragray.geometry.probe import Probe
from ultragray.geometry.registration import Registration
from ultragray.learn.localization.settings import LocalizationSettings
from ultragray.learn.planning.settings import MAX_LISTED, PlanSettings
from ultragray.rendering.settings import FrameSettings, RenderSettings, registration_field
from ultragray.scene.edits import Edit
from ultragray_service.core.clocks import ClockStamps
from ultragray_service.core.editing import EditTarget, LabelTarget, RecipeTarget, check_painted_count
from ultragray_service.core.poses import Pose, check_pose_count
from ultragray_service.core.recordings import MAX_NUMBER, IncomingFrame
from ultragray_service.core.streams import MAX_POSE_BYTES, MAX_TIMEOUT_MS, MAX_WINDOW, StreamMode
from ultragray_service.errors import BodyTooLarge, UnsupportedMediaType
from ultragray_service.http.dependencies import require_uncompressed
from ultragray_service.http.problems import invalid_argument
from ultragray_workers.jobs.kinds import KINDS, Specification
from ultragray_workers.jobs.record import MAX_PRIORITY

INLINE_BYTES = 64 * 1024  # of a body that is read at once: a few milliseconds
MAX_VALUES = 100_000  # of a body that has no limit of its own: about ten milliseconds
_MAX_DIGITS = 400  # of a number; one of a million takes long to read
_SMALL_VALUES, _ELEMENT_VALUES = 4096, 64
_DIGITS = bytes(b"0"[0] if chr(byte).isdecimal() and byte < 128 else b" "[0] for byte in range(256))

_READER = ThreadPoolExecutor(1, "large-bodies")  # one at a time: they share one lock of the interpreter

T = TypeVar("T")


@dataclass(frozen=True)
class Apart:
    """The key of a body under which much may stand, and how that is read."""

    key: str
    kind: type[Any]  # list or dict
    element: Any = None  # the class of a list's elements; None: taken as it is
    error: type[InvalidArgument] = InvalidArgument
    check_count: Callable[[int], None] = lambda count: None
    max_bytes: float = math.inf  # of the whole body
    max_values: float = MAX_VALUES
    max_characters: int = INLINE_BYTES  # of the texts of an element
    max_element_values: int = _ELEMENT_VALUES
    max_other_characters: int = INLINE_BYTES  # of the texts beside them


async def read_large(body: bytes, cls: type[T], apart: Apart | None) -> T:
    _require_size(len(body), apart)
    return await asyncio.get_running_loop().run_in_executor(_READER, _read, body, cls, apart)


def _require_size(count: int, apart: Apart | None) -> None:
    if apart is not None and count > apart.max_bytes:
        raise BodyTooLarge(f"this body must be at most {apart.max_bytes} bytes, got {count}", field="body")


def _read(body: bytes, cls: type[T], apart: Apart | None) -> T:
    document = _decoded(body, MAX_VALUES if apart is None else apart.max_values)
    most = INLINE_BYTES if apart is None else apart.max_other_characters
    if apart is None or not isinstance(document, dict) or not isinstance(document.get(apart.key), apart.kind):
        return _small(document, cls, most)
    much = document[apart.key]
    rest: Any = _small({**document, apart.key: apart.kind()}, cls, most)
    if apart.element is not None:
        apart.check_count(len(much))
        much = [_element(apart, index, one) for index, one in enumerate(much)]
    whole: T = replace(rest, **{apart.key: much})
    return whole


def _decoded(body: bytes, max_values: float) -> Any:
    if re.match(rb"\s*\{", body) is None:
        raise InvalidArgument("the body must be a JSON object")
    letters = np.frombuffer(body, np.uint8)  # bytes.count takes ten times as long where there are many
    if sum(int(np.count_nonzero(letters == letter)) for letter in b",[{") > max_values:
        raise InvalidArgument(
            f"a body must hold at most {max_values} values; many poses of a job are sent in base64, or over gRPC",
            field="body",
        )
    if b"0" * _MAX_DIGITS in body.translate(_DIGITS):
        raise InvalidArgument(f"a number must have less than {_MAX_DIGITS} digits", field="body")
    try:
        return json.loads(body)
    except RecursionError:
        raise InvalidArgument("this must be JSON: it nests too deeply") from None
    except ValueError as error:
        raise InvalidArgument(f"this must be JSON: {error}") from None


def _small(value: Any, cls: type[T], most_characters: int) -> T:
    if not _is_small(value, _SMALL_VALUES, most_characters):
        raise InvalidArgument(
            f"the body must hold at most {_SMALL_VALUES} values and {most_characters} characters beside its poses",
            field="body",
        )
    return read_json(json.dumps(value), cls)


def _element(apart: Apart, index: int, value: Any) -> Any:
    path = f"{apart.key}[{index}]"
    if not _is_small(value, apart.max_element_values, apart.max_characters):
        raise apart.error(f"{path} must hold at most {apart.max_element_values} values", field=path)
    try:
        return read_json(json.dumps(value), apart.element)
    except UltragrayError as error:
        raise error_under(path, error, apart.error) from None


def _is_small(value: Any, most: int, most_characters: int) -> bool:
    waiting, values, characters = [value], 0, 0
    while waiting and values <= most and characters <= most_characters:
        one = waiting.pop()
        values += 1
        if isinstance(one, str):
            characters += len(one)
        elif isinstance(one, dict):
            waiting += (*one, *one.values())
        elif isinstance(one, list):
            waiting += one
    return not waiting and values <= most and characters <= most_characters


@cache
def adapter_of(cls: Any) -> TypeAdapter[Any]:
    return TypeAdapter(cls)


def body_schema(cls: Any, examples: dict[str, Any] | None = None) -> dict[str, Any]:
    """The part of the OpenAPI document about a body that a route reads by itself."""
    content: dict[str, Any] = {"schema": {"$ref": f"#/components/schemas/{cls.__name__}"}}
    if examples is not None:
        content["examples"] = examples
    return {"requestBody": {"required": True, "content": {"application/json": content}}}


async def read_json_body(request: Request, cls: type[T], apart: Apart | None = None) -> T:
    """The body, checked; `apart` says which part of it may be large. Raises UnsupportedMediaType, BodyTooLarge."""
    content_type = request.headers.get("content-type", "application/json")
    media_type = content_type.partition(";")[0].strip().lower()
    if media_type != "application/json" and not media_type.endswith("+json"):
        raise UnsupportedMediaType(f"Content-Type must be application/json, got {content_type!r}", field="Content-Type")
    require_uncompressed(request)
    announced = request.headers.get("content-length", "")
    _require_size(int(announced) if announced.isdigit() else 0, apart)  # before it is read
    body = await request.body()
    return read_json(body, cls) if len(body) <= INLINE_BYTES else await read_large(body, cls, apart)


def read_json(text: str | bytes, cls: type[T]) -> T:
    try:
        kind: Any = cls
        value: T = adapter_of(kind).validate_json(text)
    except ValidationError as error:
        raise invalid_argument(error.errors(include_url=False)[0], cls) from None
    return value


_POSE_BYTES, _POSE_VALUES = 1024, 32  # with room for indentation, and for what makes a pose none
_ANNOTATIONS_CHARACTERS = 2**22  # of the pictures over a few hundred frames
_LONGEST_LOOP_MS = 24 * 3600 * 1000.0


def _many_poses(limit: int, other_characters: int = INLINE_BYTES) -> Apart:
    return Apart(
        "poses",
        list,
        Pose,
        InvalidPose,
        lambda count: check_pose_count(count, limit),
        max_bytes=other_characters + limit * _POSE_BYTES,
        max_values=2 * _SMALL_VALUES + limit * _POSE_VALUES,
        max_other_characters=other_characters,
    )


@dataclass(frozen=True, kw_only=True)
class AssessBody(Contract):
    """The poses to assess."""

    poses: list[Pose] = described("At least one.", factory=list, error=InvalidPose)
    probe: Probe | None = described("Whose poses they are. Default: the scene's own.", None)
    registration: str | None = registration_field()

    many_poses = staticmethod(_many_poses)


@dataclass(frozen=True, kw_only=True)
class LocalizeBody(LocalizationSettings):
    """A real frame, and about where it was taken."""

    image: str = described(
        "The frame in base64, rows along depth, columns across scan lines, not scan-converted: a PNG file, or, with "
        "image_height and image_width, grey pixels of 8 bits, row by row."
    )
    image_height: int | None = described("Of grey pixels.", None, low=1, high=MAX_IMAGE_SIDE, error=InvalidImageSize)
    image_width: int | None = described("Of grey pixels.", None, low=1, high=MAX_IMAGE_SIDE, error=InvalidImageSize)
    start: Pose | None = described(
        "A pose that is about right; needed unless search is anywhere.", None, error=InvalidPose
    )
    registration: str | None = registration_field()
    timeout_ms: float | None = described(
        "A search that has not ended by then is given up (504).", None, above=0, high=MAX_TIMEOUT_MS
    )


LARGE_IMAGE = Apart("image", str)


@dataclass(frozen=True, kw_only=True)
class PlanBody(PlanSettings):
    """Which views are looked for."""

    poses: list[Pose] | None = described(
        f"All that is in reach, at most {MAX_LISTED}, instead of the skin. Default: the skin.", None, error=InvalidPose
    )
    view: Pose | None = described("A standard plane: only the points of its image count.", None, error=InvalidPose)
    start: Pose | None = described("Where the probe is. Default: the way begins anywhere.", None, error=InvalidPose)
    registration: str | None = registration_field()
    timeout_ms: float | None = described(
        "A plan that is not ready by then is given up (504).", None, above=0, high=MAX_TIMEOUT_MS
    )

    many_poses = staticmethod(partial(_many_poses, MAX_LISTED))


@dataclass(frozen=True, kw_only=True)
class PaintedFrame(Contract):
    """A frame that somebody painted on."""

    pose: Pose = described("Where the frame was rendered, or taken.", error=InvalidPose)
    labels: str = described(
        "A grey PNG file of 8 bits in base64, rows along depth, columns across scan lines, not scan-converted: the "
        "label of each pixel, 0: no label, 255: not painted."
    )


@dataclass(frozen=True, kw_only=True)
class LabelBody(LabelTarget):
    """Painted frames, in the order in which they were painted."""

    frames: list[PaintedFrame] = described("At least one; a later one counts more where it contradicts.", factory=list)
    probe: Probe | None = described("Of the frames. Default: the scene's own.", None)
    registration: str | None = registration_field()


PAINTED_FRAMES = Apart(
    "frames", list, PaintedFrame, max_characters=2**23, check_count=check_painted_count, max_bytes=2**27
)


@dataclass(frozen=True, kw_only=True)
class LabelMapBody(LabelTarget):
    """A label map in three dimensions."""

    label_map: str = described("A NIfTI-1 file (.nii, .nii.gz) in base64, of whole numbers, 0: no label.")
    registration: str | None = described(
        "Name of the registration whose base_to_scene leads the map, in mm, into the scene. Default: it lies there.",
        None,
    )


LABEL_MAP = Apart("label_map", str)


@dataclass(frozen=True, kw_only=True)
class EditBody(EditTarget):
    """Edits, and the scene to make by them. Files of shapes are base64 in `data`."""


@dataclass(frozen=True, kw_only=True)
class RecipeBody(RecipeTarget):
    """Bodies of tissue, and the scene to make of them. Files are base64."""


RECIPE_MAP = Apart("label_map", str, max_other_characters=2**26, max_bytes=2**27)
EDITS = Apart(
    "edits", list, Edit, max_characters=2**26, max_element_values=2 * MAX_VALUES, max_bytes=2**27
)  # the strokes of a brush are thousands of spheres


@dataclass(frozen=True, kw_only=True)
class RenderBody(FrameSettings):
    """What to render. Exactly one of `pose` and `poses`; all else has a default from the scene."""

    pose: Pose | None = described("One pose; rendered before frames of `poses` that wait.", None, error=InvalidPose)
    poses: list[Pose] | None = described("Many poses, answered together, in order.", None, error=InvalidPose)
    registration: str | None = registration_field()
    dtype: Literal["uint8", "float32", "float16"] | None = described(
        "Of application/octet-stream; a dtype in the Accept header goes first. Default: uint8.", None
    )
    timeout_ms: float | None = described(
        "A frame that is not ready after this time is given up (504).", None, above=0, high=MAX_TIMEOUT_MS
    )
    max_queue_ms: float | None = described(
        "A request that cannot begin within this time is refused at once (429, QUEUE_FULL); null: see "
        "ULTRAGRAY_MAX_QUEUE_MS, which holds all the same.",
        None,
        above=0,
        high=MAX_TIMEOUT_MS,
    )
    frame_times_ms: tuple[float, ...] | None = described(
        "Of application/dicom: when each frame was seen, from any beginning on. Default: 40 ms after each other.", None
    )
    annotations: tuple[Annotation, ...] = described("Of application/dicom: what is burnt into the frames.", ())

    many_poses = staticmethod(partial(_many_poses, other_characters=_ANNOTATIONS_CHARACTERS))

    def check_stored(self, count: int) -> None:
        """Checks what a file of so many frames is told about them. Raises InvalidArgument."""
        times = self.frame_times_ms
        if times is not None and not (
            len(times) == count
            and all(one <= later for one, later in pairwise(times))
            and times[-1] - times[0] <= _LONGEST_LOOP_MS
        ):
            raise InvalidArgument(
                f"frame_times_ms must be a number for each of {count} poses, none below the one before it, of one day",
                field="frame_times_ms",
            )
        for index, one in enumerate(self.annotations):
            if one.frame >= count:
                path = f"annotations[{index}].frame"
                raise InvalidArgument(f"{path} must be below {count}, the number of poses, got {one.frame}", field=path)

    def poses_by_path(self, limit: int) -> Sequence[tuple[str, Pose]]:
        """The poses, each with its path in the body. Raises InvalidArgument, TooManyPoses."""
        if (self.pose is None) == (self.poses is None):
            raise InvalidArgument("the body must hold exactly one of pose and poses", field="pose")
        if self.pose is not None:
            return [("pose", self.pose)]
        poses = self.poses or []
        check_pose_count(len(poses), limit)
        return [(f"poses[{index}]", pose) for index, pose in enumerate(poses)]


@dataclass(frozen=True, kw_only=True)
class Stamps(Contract):
    """What aligns the clocks of client and service: the newest answer that has come, and when this message goes."""

    answer_sent_ms: float = described("The answer's sent_ms.")
    answer_arrived_ms: float = described("When it came, by the client's clock, that of client_time_ms.")
    sent_ms: float = described("When this message is sent, by the client's clock.")

    def in_seconds(self) -> ClockStamps:
        return ClockStamps(self.answer_sent_ms / 1e3, self.answer_arrived_ms / 1e3, self.sent_ms / 1e3)


@dataclass(frozen=True, kw_only=True)
class RealFrameHeader(Contract):
    """What is told of a real frame: rows along depth, columns across scan lines, not scan-converted."""

    client_time_ms: float = described("When it was taken: between those of two poses, whose way led to its own.")
    image_height: int | None = described(
        "Of grey pixels of 8 bits, row by row. Default: the image is a PNG file.",
        None,
        low=1,
        high=MAX_IMAGE_SIDE,
        error=InvalidImageSize,
    )
    image_width: int | None = described("Likewise.", None, low=1, high=MAX_IMAGE_SIDE, error=InvalidImageSize)


@dataclass(frozen=True, kw_only=True)
class StreamMessage(Contract):
    """One message of the client of a WebSocket."""

    sequence: int = described("Any number; the answer to this message carries it.", 0, low=0, high=2**64 - 1)
    settings: RenderSettings | None = described("Replaces all settings, from this pose on.", None)
    pose: Pose | None = described("null: only the settings change.", None, error=InvalidPose)
    mode: StreamMode | None = described("Of the stream; read from its first message. Default: ordered.", None)
    timeout_ms: float | None = described("Later this pose is not rendered.", None, above=0, high=MAX_TIMEOUT_MS)
    client_time_ms: float | None = described(
        "Any number, such as when the pose was measured; the answer carries it.", None
    )
    predict_ms: float | None = described(
        "The frame is to be that of where the probe will be so long after client_time_ms, when its pose was measured: "
        "foretold from the poses of the stream that have this, too. Absent: the frame of the pose itself.",
        None,
        low=0,
        high=MAX_AHEAD_MS,
    )
    real: RealFrameHeader | None = described(
        "A real frame that has come, late: the scene's frames are corrected by it. The message is a binary one: length "
        "of the JSON (uint32, little endian), the JSON, the image.",
        None,
    )
    clock: Stamps | None = described("Aligns the clocks; answers tell their offset then.", None)
    window: int | None = described(
        "Of a latest stream, read from its first message: answers that may wait to be acknowledged. Default: the "
        "client acknowledges none.",
        None,
        low=1,
        high=MAX_WINDOW,
    )
    acknowledged: int | None = described(
        "Sequence of the newest answer that the client has taken; it and those before it leave room for others.",
        None,
        low=0,
        high=2**64 - 1,
    )


def message_parts(received: str | bytes) -> tuple[str | bytes, bytes]:
    """The JSON of a message, and the image of a binary one, which is made as those of frames are.

    Raises InvalidArgument.
    """
    begin, end = 0, len(received)
    if isinstance(received, bytes):
        begin, end = 4, 4 + int.from_bytes(received[:4], "little")
        if len(received) < end:
            raise InvalidArgument(f"the JSON of a binary message must have the {end - 4} bytes that its first 4 say")
    if end - begin > MAX_POSE_BYTES:
        raise InvalidArgument(f"the JSON of a message must have at most {MAX_POSE_BYTES} bytes, got {end - begin}")
    return received[begin:end], received[end:] if isinstance(received, bytes) else b""


@dataclass(frozen=True, kw_only=True)
class FrameHead(Contract):
    """The JSON before the image of a real frame."""

    pose: Pose = described("Of the probe, in the frame of the tracker.", error=InvalidPose)
    number: int | None = described(
        "In the sender's count, which grows; one that is missing is a lost frame. Default: the next.",
        None,
        low=0,
        high=MAX_NUMBER,
    )
    time_s: float | None = described("When it was taken.", None)


def read_incoming_frame(body: bytes) -> IncomingFrame:
    """A real frame: a FrameHead and the image, as `message_parts` has them. Raises InvalidArgument and its kinds."""
    text, image = message_parts(body)
    head = read_json(text, FrameHead)
    return IncomingFrame(pose=head.pose.exact("pose"), image=image, number=head.number, time_s=head.time_s)


def number_of_frame(body: bytes) -> int | None:
    """The number of a real frame whose other parts cannot be read; None where it tells none, or not one."""
    try:
        head = json.loads(message_parts(body)[0])
    except (InvalidArgument, ValueError, RecursionError):
        return None
    number = head.get("number") if isinstance(head, dict) else None
    return number if type(number) is int and 0 <= number <= MAX_NUMBER else None


@dataclass(frozen=True, kw_only=True)
class RegistrationBody(Registration):
    """A registration, and the scene that its poses lead into."""

    scene: str = described("Its name.")


def _body_of(kind: str) -> type[Any]:
    """The class of a specification's JSON, which `kind` stands beside: poses are lists."""
    cls = Specification.member(kind)
    fields = [(item, annotation) for item, annotation in annotated_fields(cls) if item.name != "kind"]
    described_fields: list[tuple[str, Any, Any]] = [
        (item.name, _without_arrays(annotation), _again(item)) for item, annotation in fields
    ]
    name = f"{kind.title()}Specification"
    return make_dataclass(name, described_fields, namespace={"__doc__": cls.__doc__}, kw_only=True)


def _again(item: Field[Any]) -> Any:
    return field(default=item.default, default_factory=item.default_factory, metadata=item.metadata)


def _without_arrays(annotation: Any) -> Any:
    kinds = [one for one in get_args(annotation) if getattr(one, "__origin__", None) is not np.ndarray]
    if len(kinds) == len(get_args(annotation)):
        return annotation
    first, *others = kinds
    for other in others:
        first = first | other
    return first


SPECIFICATION = Apart("specification", dict)  # of a job: there may be many poses in it
SPECIFICATIONS = tuple(map(_body_of, KINDS))


@dataclass(frozen=True, kw_only=True)
class JobBody(Contract):
    """A job to be done in the background."""

    kind: str = described("What is to be done.", choices=KINDS)
    specification: dict[str, Any] = field(
        metadata={
            "description": f"{' or '.join(one.__name__ for one in SPECIFICATIONS)}, by kind. Poses may also be "
            "one text: float64, row by row, the low byte first, in base64.",
            "json_schema_extra": {
                "anyOf": [{"$ref": f"#/components/schemas/{one.__name__}"} for one in SPECIFICATIONS]
            },
        }
    )
    request_id: str | None = described(
        "Chosen by the client, 1 to 128 characters: sent again, it gives the same job.", None
    )
    priority: int = described("Higher ones go first.", 0, low=-MAX_PRIORITY, high=MAX_PRIORITY)
    private: bool = described("Whether others may not see it, nor the scene that it makes.", False)


class FileParts:
    def __init__(self, content_type: str) -> None:
        _, parameters = parse_options_header(content_type)
        boundary = parameters.get(b"boundary", b"")
        self._events: list[str | bytes] = []
        self._header_name, self._header_value = bytearray(), bytearray()
        self._disposition = b""
        self._complete = False
        try:
            self._parser = MultipartParser(
                boundary,
                {
                    "on_header_field": lambda data, start, end: self._header_name.extend(data[start:end]),
                    "on_header_value": lambda data, start, end: self._header_value.extend(data[start:end]),
                    "on_header_end": self._end_header,
                    "on_headers_finished": self._end_headers,
                    "on_part_data": lambda data, start, end: self._events.append(data[start:end]),
                    "on_end": self._end,
                },
            )
        except FormParserError as error:
            raise InvalidArgument(f"Content-Type has no boundary that can be used: {error}") from error
        if not boundary:
            raise InvalidArgument("Content-Type multipart/form-data must have a boundary", field="Content-Type")

    def feed(self, block: bytes) -> list[str | bytes]:
        """The names of files (str) and their bytes in the block. Raises InvalidArgument for a damaged body."""
        try:
            self._parser.write(block)
        except FormParserError as error:
            raise InvalidArgument(f"the body is no multipart/form-data: {error}", field="body") from error
        events, self._events = self._events, []
        return events

    def finish(self) -> None:
        if not self._complete:
            raise InvalidArgument("the body is truncated: its last boundary is missing", field="body")

    def _end_header(self) -> None:
        if self._header_name.lower() == b"content-disposition":
            self._disposition = bytes(self._header_value)
        self._header_name.clear()
        self._header_value.clear()

    def _end_headers(self) -> None:
        _, parameters = parse_options_header(self._disposition)
        self._disposition = b""
        name = parameters.get(b"filename")
        if name is None:
            field = parameters.get(b"name", b"").decode(errors="replace")[:80]
            raise InvalidArgument(
                f"each part must be a file with a filename, {field!r} is none (options are query parameters)",
                field="body",
            )
        self._events.append(name.decode(errors="replace"))

    def _end(self) -> None:
        self._complete = True

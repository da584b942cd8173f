"""Commands of PLUS over OpenIGTLink: a client sets its scanner and asks how it is set."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any
from xml.etree import ElementTree

from ultragray.contract import Contract, from_dict, shown, to_dict, under
from ultragray.errors import InvalidArgument, InvalidProbe, UltragrayError
from ultragray.geometry.motion import MAX_AHEAD_MS, PathPredictor, Prediction
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.geometry.registration import Registration
from ultragray.rendering.display import AS_RENDERED, FRAME_RANGE_DB
from ultragray.rendering.settings import FrameSettings
from ultragray.rendering.tools import MAX_TOOLS, Tool
from ultragray.scene.modes import Breathing
from ultragray_service.core.registrations import Registrations
from ultragray_service.errors import IgtlMessageInvalid
from ultragray_service.igtl.messages import DEVICE_NAME_BYTES, Message, pack_text, unpack_text
from ultragray_service.igtl.routes import SceneChooser

_NAME_BYTES = 128
_COMMAND = struct.Struct(f">I{_NAME_BYTES}sHI")
_STRING = struct.Struct(">HH")
_UTF8 = 106  # the number of the character set at IANA; ASCII (3) is a part of it
_MOST_STRING_BYTES = 0xFFFF


@dataclass(frozen=True)
class Command:
    """A command or its reply. `name` may be empty where `text`, which is XML, has it."""

    number: int
    name: str
    text: str


def unpack_command(content: bytes) -> Command:
    """The command of a COMMAND, the reply of an RTS_COMMAND. Raises IgtlMessageInvalid."""
    if len(content) < _COMMAND.size:
        raise IgtlMessageInvalid(f"COMMAND must hold {_COMMAND.size} bytes or more, got {len(content)}", field="body")
    number, name, _, length = _COMMAND.unpack_from(content)
    return Command(number, unpack_text(name), _text("COMMAND", content[_COMMAND.size :], length))


def pack_command(command: Command) -> bytes:
    """The content of a COMMAND or an RTS_COMMAND; the name is cut at 127 bytes."""
    text = command.text.encode()
    return _COMMAND.pack(command.number, pack_text(command.name, _NAME_BYTES - 1), _UTF8, len(text)) + text


def unpack_string(content: bytes) -> str:
    if len(content) < _STRING.size:
        raise IgtlMessageInvalid(f"STRING must hold {_STRING.size} bytes or more, got {len(content)}", field="body")
    _, length = _STRING.unpack_from(content)
    return _text("STRING", content[_STRING.size :], length)


def pack_string(text: str) -> bytes:
    """The content of a STRING; the text is cut at 65,535 bytes."""
    encoded = pack_text(text, _MOST_STRING_BYTES)
    return _STRING.pack(_UTF8, len(encoded)) + encoded


def _text(type_name: str, data: bytes, length: int) -> str:
    if len(data) != length:
        raise IgtlMessageInvalid(f"{type_name}: a text of {length} bytes must follow, got {len(data)}", field="body")
    try:
        return data.decode().rstrip("\0")
    except UnicodeDecodeError:
        raise IgtlMessageInvalid(f"{type_name}: its text must be ASCII or UTF-8", field="body") from None


# The XML of commands and replies, as PLUS has it.
# <Command Name="SetUsParameter"><Parameter Name="DepthMm" Value="40"/></Command> <CommandReply Name="SetUsParameter"
# Status="SUCCESS" Message="…"><Parameter Name="DepthMm" Success="true"/>…
MAX_COMMAND_BYTES = 4096
MAX_PARAMETERS = 32  # of one command


@dataclass(frozen=True)
class Reply:
    """The reply to a command, which failed where it has an error, or where a parameter has one."""

    name: str
    error: str = ""
    outcomes: tuple[tuple[str, str, str | None], ...] = ()  # parameters, errors, else the values that were asked for

    @property
    def errors(self) -> str:
        return "; ".join(filter(None, [self.error, *(error for _, error, _ in self.outcomes)]))

    @property
    def xml(self) -> str:
        errors = self.errors
        root = ElementTree.Element("CommandReply", Name=_plain(self.name), Status="FAIL" if errors else "SUCCESS")
        root.set("Message", _plain(errors or f"{self.name} completed"))
        if errors:
            root.set("Error", _plain(errors))
        for parameter, error, value in self.outcomes:
            element = ElementTree.SubElement(root, "Parameter", Name=parameter)
            element.set("Success", "false" if error else "true")
            if value is not None:
                element.set("Value", _plain(value))
        return ElementTree.tostring(root, encoding="unicode")

    @property
    def metadata(self) -> dict[str, str]:
        """The reply as messages of version 2 carry it beside the XML."""
        values = {parameter: "FAIL" if error else value or "SUCCESS" for parameter, error, value in self.outcomes}
        return {**values, **({"Status": "FAIL", "Error": self.errors} if self.errors else {"Status": "SUCCESS"})}


def read_request(name: str, text: str) -> tuple[str, Mapping[str, str | None]]:
    """The command of an XML text: its name, which the message may have told, and the values of its parameters.

    Raises IgtlMessageInvalid for a text that is none. It may define no entities, which could grow without bounds.
    """
    root = _root(text)
    own_name = root.get("Name", "")
    if own_name and name and own_name.casefold() != name.casefold():
        raise _invalid(f"the message calls the command {shown(name)}, its XML {shown(own_name)}")
    if len(root) > MAX_PARAMETERS:
        raise _invalid(f"a command may have at most {MAX_PARAMETERS} parameters, got {len(root)}")
    parameters: dict[str, str | None] = {}
    for element in root:
        parameter = element.get("Name", "")
        if element.tag != "Parameter" or not parameter:
            raise _invalid(f'Command must hold elements <Parameter Name="…"/>, got {shown(element.tag)}')
        if parameter in parameters:
            raise _invalid(f"each parameter may be named once, got {shown(parameter)} twice")
        parameters[parameter] = element.get("Value")
    return name or own_name, parameters


def _root(text: str) -> ElementTree.Element:
    size = len(text.encode())
    if size > MAX_COMMAND_BYTES:
        raise _invalid(f"a command may have at most {MAX_COMMAND_BYTES} bytes, got {size}")
    if "<!DOCTYPE" in text:
        raise _invalid("a command has no DOCTYPE")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise _invalid(f'a command must be XML such as <Command Name="GetUsParameter">…</Command>: {error}') from None
    if root.tag != "Command":
        raise _invalid(f"the XML of a command must be an element Command, got {shown(root.tag)}")
    return root


def _invalid(detail: str) -> IgtlMessageInvalid:
    return IgtlMessageInvalid(detail, field="body")


def _plain(text: str) -> str:
    """The text without characters that XML cannot hold."""
    return "".join(one if one.isprintable() else "?" for one in text)


_MOST_PATHS = 64  # of devices, which are named by the client
_DEVICE, _FRAME = "device", "frame"
_EXAMPLE = '[{"kind": "needle", "tip_mm": [0, 0, 0], "hub_mm": [0, 0, -120], "device": "NeedleToReference"}]'


@dataclass(frozen=True)
class ClientTool:
    tool: Tool
    device: str | None  # that moves it, and whose frame its points are in; None: it stays


@dataclass(frozen=True, eq=False)
class ClientTools:
    tools: tuple[ClientTool, ...] = ()
    poses: Mapping[str, FloatArray] = field(default_factory=dict)  # [4, 4] mm, exact, by device

    def are_moved_by(self, device: str) -> bool:
        return any(one.device == device for one in self.tools)

    def moved(self, device: str, pose: FloatArray) -> ClientTools:  # [4, 4] mm, exact
        return replace(self, poses={**self.poses, device: pose})

    def placed(self, registration: Registration | None) -> tuple[Tool, ...]:
        """The tools of a frame: those of a device in the scene, and none whose device has sent no pose yet.

        `registration` leads from the frame that the poses of the devices lead to into the scene; None: it is the scene.
        """
        tools = []
        for one in self.tools:
            if one.device is None:
                tools.append(one.tool)
            elif (pose := self.poses.get(one.device)) is not None:
                to_scene = pose if registration is None else registration.marker_to_scene(pose)
                tools.append(one.tool.moved(to_scene))
        return tuple(tools)


def read_tools(text: str, before: ClientTools) -> ClientTools:
    """The tools of a JSON text; devices of `before` are where they were. Raises InvalidArgument, naming the tool."""
    try:
        documents = json.loads(text)
    except (ValueError, RecursionError):
        documents = None
    if not isinstance(documents, list):
        raise InvalidArgument(f"must be a list in JSON such as {_EXAMPLE}, got {shown(text)}")
    if len(documents) > MAX_TOOLS:
        raise InvalidArgument(f"must be at most {MAX_TOOLS} tools, got {len(documents)}")
    tools = tuple(_read(number, one) for number, one in enumerate(documents))
    devices = {one.device for one in tools}
    return ClientTools(tools, {device: pose for device, pose in before.poses.items() if device in devices})


def _read(number: int, document: Any) -> ClientTool:
    with under(f"[{number}]"):
        device = None
        if isinstance(document, dict) and document.get(_DEVICE) is not None:
            device = document[_DEVICE]
            if not isinstance(device, str) or not 1 <= len(device.encode()) <= DEVICE_NAME_BYTES:
                raise InvalidArgument(
                    f"device must be the name of one, of 1 to {DEVICE_NAME_BYTES} bytes, got {shown(device)}",
                    field=_DEVICE,
                )
            if _FRAME in document:
                raise InvalidArgument("frame stands in place of device: the points are in the device's", field=_FRAME)
            document = {name: value for name, value in document.items() if name != _DEVICE}
        return ClientTool(from_dict(Tool, document), device)


def _document(one: ClientTool) -> dict[str, Any]:
    document: dict[str, Any] = to_dict(one.tool)
    if one.device is None:
        return document
    return {**{name: value for name, value in document.items() if name != _FRAME}, _DEVICE: one.device}


_NO_GAIN_PERCENT = 50.0
_DB_A_PERCENT = FRAME_RANGE_DB / 100.0
_SCENE, _REGISTRATION, _TOOLS, _PREDICT = "Scene", "Registration", "Tools", "PredictMs"


@dataclass(frozen=True)
class _Parameter:
    """A field of the settings, and its text."""

    field: str
    read: Callable[[str], Any]
    write: Callable[[Any], str]


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InvalidArgument(f"must be a number, got {shown(text)}") from None


def _gain_db(text: str) -> float:
    percent = _number(text)
    if not 0.0 <= percent <= 100.0:
        raise InvalidArgument(f"must be a number from 0 to 100, got {shown(text)}")
    return (percent - _NO_GAIN_PERCENT) * _DB_A_PERCENT


def _predict_ms(text: str) -> float:
    if not 0.0 <= (predict_ms := _number(text)) <= MAX_AHEAD_MS:
        raise InvalidArgument(f"must be a number from 0 to {MAX_AHEAD_MS:g}, got {shown(text)}")
    return predict_ms


def _number_text(number: float) -> str:
    return f"{number:.10g}"


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(map(_number, text.split()))


def _numbers_text(numbers: Sequence[float]) -> str:
    return " ".join(map(_number_text, numbers))


def _probe(text: str) -> Probe:
    try:
        document = to_dict(Probe.named[text]) if text in Probe.named else json.loads(text)
    except (ValueError, RecursionError):
        names = ", ".join(Probe.named)
        raise InvalidProbe(
            f'must be one of {names}, or JSON such as {{"kind": "linear", …}}, got {shown(text)}'
        ) from None
    return from_dict(Probe, document)


def _breathing(text: str) -> Breathing:
    try:
        document = json.loads(text)
    except (ValueError, RecursionError):
        raise InvalidArgument(f"must be JSON such as {_json(Breathing())}, got {shown(text)}") from None
    return from_dict(Breathing, document)


def _json(value: Contract) -> str:
    return json.dumps(to_dict(value, with_none=False))


_DISPLAY: Mapping[str, _Parameter] = {
    "DepthMm": _Parameter("depth_mm", _number, _number_text),
    "GainPercent": _Parameter("gain_db", _gain_db, lambda db: _number_text(_NO_GAIN_PERCENT + db / _DB_A_PERCENT)),
    "DynRangeDb": _Parameter("dynamic_range_db", _number, _number_text),
    "TimeGainCompensation": _Parameter("tgc_db", _numbers, _numbers_text),
}
_FRAMES: Mapping[str, _Parameter] = {  # none: ""
    "Probe": _Parameter("probe", _probe, _json),
    "Phase": _Parameter("phase", _numbers, _numbers_text),
    "Breathing": _Parameter("breathing", _breathing, _json),
    "Contact": _Parameter("contact", str, lambda contact: contact.value),
    "IndentationMm": _Parameter("indentation_mm", _number, _number_text),
}
PARAMETERS = (*_DISPLAY, _SCENE, *_FRAMES, _REGISTRATION, _PREDICT, _TOOLS)


@dataclass(frozen=True, eq=False)
class Setup:
    """All that the frames of a connection are rendered with; another object after each change."""

    settings: FrameSettings
    registration: str | None = None  # that leads the poses of devices into the scene
    tools: ClientTools = field(default_factory=ClientTools)
    predict_ms: float | None = None  # how much later than its stamp the frame of a pose is to be; None: as it was


class Scanner:
    """The setup of the frames of one connection, and the scene of its devices that name none."""

    def __init__(self, scenes: SceneChooser, registrations: Registrations, setup: Setup) -> None:
        self.setup, self._scenes, self._registrations = setup, scenes, registrations
        self._paths: dict[str, PathPredictor] = {}  # by device

    def foretell(self, device: str, measured_s: float, pose: FloatArray) -> tuple[FloatArray, Prediction | None]:
        """Where a device will be by the time of its frame, [4, 4] mm in its own frame as the pose is."""
        if self.setup.predict_ms is None:
            return pose, None
        if device not in self._paths and len(self._paths) == _MOST_PATHS:
            self._paths.clear()
        path = self._paths.setdefault(device, PathPredictor())
        path.observe(measured_s, pose)
        return path.predict(measured_s + self.setup.predict_ms / 1e3)

    def move(self, device: str, pose: FloatArray) -> None:  # [4, 4] mm, exact
        self.setup = replace(self.setup, tools=self.setup.tools.moved(device, pose))

    async def set(self, parameter: str, value: str) -> None:
        """Sets a parameter for the frames to come. Raises InvalidArgument, SceneNotFound, RegistrationNotFound."""
        if parameter == _SCENE:
            await self._scenes.prefer(value)
        elif parameter == _REGISTRATION:
            if value:
                await self._scenes.prefer((await self._registrations.get(value)).scene)
            self.setup = replace(self.setup, registration=value or None)
        elif parameter == _TOOLS:
            self.setup = replace(self.setup, tools=read_tools(value, self.setup.tools))
        elif parameter == _PREDICT:
            self._paths.clear()
            self.setup = replace(self.setup, predict_ms=_predict_ms(value) if value else None)
        elif (of_frames := _FRAMES.get(parameter)) is not None:
            self._set(**{of_frames.field: of_frames.read(value) if value else None})
        else:
            of_display = _of_display(parameter)
            display = self.setup.settings.display or AS_RENDERED
            self._set(display=replace(display, **{of_display.field: of_display.read(value)}))

    def _set(self, **values: Any) -> None:
        self.setup = replace(self.setup, settings=replace(self.setup.settings, **values))

    async def get(self, parameter: str) -> str:
        """Raises InvalidArgument for a parameter that is unknown or not set, SceneNotFound where none is chosen."""
        if parameter == _SCENE:
            return await self._scenes.choose("")
        if parameter == _REGISTRATION:
            return self.setup.registration or ""
        if parameter == _TOOLS:
            return json.dumps([_document(one) for one in self.setup.tools.tools])
        if parameter == _PREDICT:
            return "" if self.setup.predict_ms is None else _number_text(self.setup.predict_ms)
        if (of_frames := _FRAMES.get(parameter)) is not None:
            value = getattr(self.setup.settings, of_frames.field)
            return "" if value is None else of_frames.write(value)
        of_display = _of_display(parameter)
        value = getattr(self.setup.settings.display or AS_RENDERED, of_display.field)
        if value is None:
            raise InvalidArgument("is not set: frames have that of their scene")
        return of_display.write(value)


def _of_display(parameter: str) -> _Parameter:
    if parameter not in _DISPLAY:
        raise InvalidArgument(f"must be one of {', '.join(PARAMETERS)}, got {shown(parameter)}")
    return _DISPLAY[parameter]


_ASKS, _ANSWERS = "CMD_", "ACK_"  # beginnings of the names of devices whose STRING is a command, and a reply
_SET, _GET = "SetUsParameter", "GetUsParameter"


async def answer(scanner: Scanner, message: Message) -> Message:
    """The reply to a COMMAND, or to a STRING of a device CMD_…, also to a wrong one. Raises IgtlMessageInvalid."""
    if message.type_name == "COMMAND":
        command = unpack_command(message.content)
        reply = await _reply(scanner, command.name, command.text)
        content = pack_command(Command(command.number, command.name or reply.name, reply.xml))
        return _message("RTS_COMMAND", message, message.device_name, content, reply.metadata)
    if not message.device_name.startswith(_ASKS):
        raise IgtlMessageInvalid(
            f"STRING is understood as a command, of a device called {_ASKS}1 or the like, got "
            f"{shown(message.device_name)}",
            field="header",
        )
    reply = await _reply(scanner, "", unpack_string(message.content))
    device_name = _ANSWERS + message.device_name[len(_ASKS) :]
    return _message("STRING", message, device_name, pack_string(reply.xml), reply.metadata)


async def _reply(scanner: Scanner, name: str, text: str) -> Reply:
    try:
        command_name, parameters = read_request(name, text)
        known = {name.casefold(): name for name in (_SET, _GET)}
        if (command := known.get(command_name.casefold())) is None:
            raise _invalid(f"the command must be {_SET} or {_GET}, got {shown(command_name)}")
        if not parameters:
            raise _invalid(f'{command} must hold an element <Parameter Name="…"/> or more')
    except IgtlMessageInvalid as error:
        return Reply(name, error.detail)
    outcomes: list[tuple[str, str, str | None]] = []
    for parameter, value in parameters.items():
        problem, answer = "", None
        try:
            if command == _GET:
                answer = await scanner.get(parameter)
            elif value is None:
                problem = f"{parameter}: a Value is required"
            else:
                await scanner.set(parameter, value)
        except UltragrayError as error:
            problem = f"{parameter}: {error.detail}"
        outcomes.append((parameter, problem, answer))
    return Reply(command, outcomes=tuple(outcomes))


def _message(type_name: str, query: Message, device_name: str, content: bytes, metadata: Mapping[str, str]) -> Message:
    return Message(type_name, device_name, content, query.timestamp, query.version, query.message_id, metadata)

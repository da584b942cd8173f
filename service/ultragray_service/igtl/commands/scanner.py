"""The scanner of one connection: the settings of its frames under the names that PLUS has for them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from ultragray.contract import from_dict, shown, to_dict
from ultragray.display.settings import AS_RENDERED, FRAME_RANGE_DB
from ultragray.errors import InvalidArgument, InvalidProbe
from ultragray.probe import FloatArray, Probe
from ultragray.settings import FrameSettings
from ultragray_service.core.registrations import Registrations
from ultragray_service.igtl.commands.tools import ClientTools, read_tools, tools_text
from ultragray_service.igtl.routes import SceneChooser

_NO_GAIN_PERCENT = 50.0
_DB_A_PERCENT = FRAME_RANGE_DB / 100.0
_SCENE, _PROBE, _REGISTRATION, _TOOLS = "Scene", "Probe", "Registration", "Tools"


@dataclass(frozen=True)
class _DisplayParameter:
    """A parameter that is a field of `Display`."""

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


def _plain(number: float) -> str:
    return f"{number:.10g}"


_DISPLAY: Mapping[str, _DisplayParameter] = {
    "DepthMm": _DisplayParameter("depth_mm", _number, _plain),
    "GainPercent": _DisplayParameter("gain_db", _gain_db, lambda db: _plain(_NO_GAIN_PERCENT + db / _DB_A_PERCENT)),
    "DynRangeDb": _DisplayParameter("dynamic_range_db", _number, _plain),
    "TimeGainCompensation": _DisplayParameter(
        "tgc_db", lambda text: tuple(map(_number, text.split())), lambda gains: " ".join(map(_plain, gains))
    ),
}
PARAMETERS = (*_DISPLAY, _SCENE, _PROBE, _REGISTRATION, _TOOLS)


@dataclass(frozen=True, eq=False)
class Setup:
    """All that the frames of a connection are rendered with; another object after each change."""

    settings: FrameSettings
    registration: str | None = None  # that leads the poses of devices into the scene
    tools: ClientTools = field(default_factory=ClientTools)


class Scanner:
    """The setup of the frames of one connection, and the scene of its devices that name none."""

    def __init__(self, scenes: SceneChooser, registrations: Registrations, setup: Setup) -> None:
        self.setup = setup
        self._scenes = scenes
        self._registrations = registrations

    def move(self, device: str, pose: FloatArray) -> None:  # [4, 4] mm, exact
        """Takes the pose of a device that moves tools, for the frames to come."""
        self.setup = replace(self.setup, tools=self.setup.tools.moved(device, pose))

    async def set(self, parameter: str, value: str) -> None:
        """Sets a parameter for the frames to come.

        Raises InvalidArgument for an unknown parameter and for a value that cannot be, InvalidProbe, SceneNotFound,
        RegistrationNotFound.
        """
        if parameter == _SCENE:
            await self._scenes.prefer(value)
        elif parameter == _REGISTRATION:
            if value:
                await self._scenes.prefer((await self._registrations.get(value)).scene)
            self.setup = replace(self.setup, registration=value or None)
        elif parameter == _TOOLS:
            self.setup = replace(self.setup, tools=read_tools(value, self.setup.tools))
        elif parameter == _PROBE:
            self._set(probe=_probe(value))
        else:
            of_display = _of_display(parameter)
            display = self.setup.settings.display or AS_RENDERED
            self._set(display=replace(display, **{of_display.field: of_display.read(value)}))

    def _set(self, **values: Any) -> None:
        self.setup = replace(self.setup, settings=replace(self.setup.settings, **values))

    async def get(self, parameter: str) -> str:
        """The value of a parameter. Raises InvalidArgument for an unknown one and for one that is not set,
        SceneNotFound where no scene is chosen."""
        if parameter == _SCENE:
            return await self._scenes.choose("")
        if parameter == _REGISTRATION:
            return self.setup.registration or ""
        if parameter == _TOOLS:
            return tools_text(self.setup.tools)
        settings = self.setup.settings
        write: Callable[[Any], str]
        if parameter == _PROBE:
            value, write = settings.probe, _probe_text
        else:
            of_display = _of_display(parameter)
            value, write = getattr(settings.display or AS_RENDERED, of_display.field), of_display.write
        if value is None:
            raise InvalidArgument("is not set: frames have that of their scene")
        return write(value)


def _of_display(parameter: str) -> _DisplayParameter:
    if parameter not in _DISPLAY:
        raise InvalidArgument(f"must be one of {', '.join(PARAMETERS)}, got {shown(parameter)}")
    return _DISPLAY[parameter]


def _probe(text: str) -> Probe:
    try:
        document = json.loads(text)
    except (ValueError, RecursionError):
        raise InvalidProbe(f'must be JSON such as {{"kind": "linear", …}}, got {shown(text)}') from None
    return from_dict(Probe, document)


def _probe_text(probe: Probe) -> str:
    return json.dumps(to_dict(probe, with_none=False))

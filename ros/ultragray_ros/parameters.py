"""The settings of a frame as ROS parameters: one for each field of RenderSettings, `display.` before those of Display.

A parameter of ROS is never None: −1 and the empty text leave a setting to the scene, [0.0] stands for no numbers. A
probe is written by its name, such as `C5-2`, or as JSON, such as `{"kind": "convex", "opening_angle_deg": 60,
"near_mm": 40, "far_mm": 95}`, and tools as a list of such objects.
Free of ROS.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from types import NoneType
from typing import Any, TypeAlias, get_args, get_origin, get_type_hints

from ultragray_client import PROBES, Display, PlanSettings, RenderSettings
from ultragray_client.errors import InvalidArgument

Value: TypeAlias = bool | int | float | str | list[str] | list[float]

DISPLAY, PLAN = "display.", "plan."
NEVER = "encoding"  # images are mono8
NO_NUMBERS = [0.0]  # for an empty list of numbers: of one that is empty ROS cannot tell the type
_LEFT_OPEN: dict[Any, Value] = {int: -1, float: -1.0}  # for what may be None; of all other kinds the empty text


def defaults() -> dict[str, Value]:
    """The parameters by their names, with the values that leave everything as the scene has it."""
    return {name: _default(item, kind) for name, item, kind in _entries(*_OF_FRAMES)}


def plan_defaults() -> dict[str, Value]:
    """The same of those of a plan."""
    return {name: _default(item, kind) for name, item, kind in _entries(_OF_PLANS)}


def plan_settings_of(values: Mapping[str, Any]) -> PlanSettings:
    """What a plan is asked for by parameters; the service checks it."""
    found = {name.removeprefix(PLAN): _read(name, kind, values[name]) for name, _, kind in _entries(_OF_PLANS)}
    return PlanSettings(**found)


def settings_of(values: Mapping[str, Any]) -> RenderSettings:
    """The settings that parameters stand for; others among them are passed over.

    Raises InvalidArgument for a word or a probe that does not exist; the service checks the rest.
    """
    found = {name: _read(name, kind, values[name]) for name, _, kind in _entries(*_OF_FRAMES)}
    display = Display(**{name.removeprefix(DISPLAY): found.pop(name) for name in tuple(found) if DISPLAY in name})
    return RenderSettings(**found, display=None if display == Display() else display)


_OF_FRAMES = (("", RenderSettings, (NEVER, "display")), (DISPLAY, Display, ()))
_OF_PLANS = (PLAN, PlanSettings, ("probe", "plane"))  # the probe is that of the frames


def _entries(*sources: tuple[str, type, tuple[str, ...]]) -> Iterator[tuple[str, Field[Any], Any]]:
    """Name, field and type of each parameter."""
    for prefix, cls, left_out in sources:
        hints = get_type_hints(cls)
        for item in fields(cls):
            if item.name not in left_out:
                yield prefix + item.name, item, hints[item.name]


def _default(item: Field[Any], kind: Any) -> Value:
    value = item.default
    if value is MISSING or value is None:
        return _left_open(kind)
    if isinstance(value, Enum):
        return str(value.value)
    if isinstance(value, tuple):
        return list(value) or NO_NUMBERS
    return value  # type: ignore[no-any-return]


def _left_open(kind: Any) -> Value:
    return _LEFT_OPEN.get(get_args(kind)[0], "")


def _read(name: str, kind: Any, value: Any) -> Any:
    inner = [one for one in get_args(kind) if one is not NoneType] or [kind]
    if NoneType in get_args(kind) and value == _left_open(kind):
        return None
    if name == "probe" and value in PROBES:
        return PROBES[value]
    if is_dataclass(inner[0]):
        return _member(name, inner, _document(name, inner, value))
    if get_origin(inner[0]) is tuple and is_dataclass((kinds := get_args(get_args(inner[0])[0]))[0]):
        members = _document(name, kinds, value)
        if not isinstance(members, list):
            raise _not_json(name, kinds, value, "it is no list")
        return tuple(_member(name, kinds, one) for one in members)
    if isinstance(inner[0], type) and issubclass(inner[0], Enum):
        return _word(name, inner[0], value)
    if get_origin(kind) is tuple:
        return () if list(value) == NO_NUMBERS else tuple(value)
    return value


def _word(name: str, kind: type[Enum], value: Any) -> Enum:
    try:
        return kind(value)
    except ValueError:
        words = ", ".join(str(one.value) for one in kind)
        raise InvalidArgument(f"{name} must be one of {words}, got {value!r}", field=name) from None


def _document(name: str, kinds: Sequence[Any], text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError as error:
        raise _not_json(name, kinds, text, error) from None


def _member(name: str, kinds: Sequence[Any], given: Any) -> Any:
    """The object of a family that a JSON object stands for, told by its kind."""
    try:
        numbers = dict(given)
        cls = {cls.kind: cls for cls in kinds}[numbers.pop("kind")]
        hints = get_type_hints(cls).items()
        words = {key: hint for key, hint in hints if isinstance(hint, type) and issubclass(hint, Enum)}
        return cls(
            **{
                key: _word(f"{name}: {key}", words[key], value) if key in words else _frozen(value)
                for key, value in numbers.items()
            }
        )
    except InvalidArgument:  # a word of it
        raise
    except (ValueError, TypeError, KeyError) as error:
        raise _not_json(name, kinds, given, error) from None


def _frozen(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _not_json(name: str, kinds: Sequence[Any], given: Any, error: object) -> InvalidArgument:
    return InvalidArgument(
        f"{name} must be JSON with a kind, one of {', '.join(cls.kind for cls in kinds)}, and its numbers, got "
        f"{given!r:.200} ({error})",
        field=name,
    )

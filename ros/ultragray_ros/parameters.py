"""The settings of a frame as ROS parameters: one for each field of RenderSettings, `display.` before those of Display.

A parameter of ROS is never None: −1 and the empty text leave a setting to the scene, [nan] stands for no numbers. A
probe is written by its name, such as `C5-2`, or as JSON, such as `{"kind": "convex", "opening_angle_deg": 60,
"near_mm": 40, "far_mm": 95}`, tools as a list of such objects, and breathing as `{"period_s": 4, "depth": 1}`.
Free of ROS.
"""

from __future__ import annotations

import json
import math
import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, fields, is_dataclass, replace
from enum import Enum
from types import NoneType
from typing import Any, TypeAlias, get_args, get_origin, get_type_hints

from ultragray_client import PROBES, Display, PlanSettings, RenderSettings
from ultragray_client.errors import InvalidArgument

Value: TypeAlias = bool | int | float | str | list[str] | list[float]

DISPLAY, PLAN = "display.", "plan."
NEVER = "encoding"  # images are mono8
NO_NUMBERS = [math.nan]  # for an empty list of numbers: of one that is empty ROS cannot tell the type
_NUMBERS = tuple[float, ...]
_LEFT_OPEN: dict[Any, Value] = {int: -1, float: -1.0, _NUMBERS: NO_NUMBERS}  # for None; else the empty text


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
    is_optional = NoneType in get_args(kind)
    inner = [one for one in get_args(kind) if one is not NoneType] if is_optional else [kind]
    if is_optional and value == _left_open(kind):
        return None
    if name == "probe" and value in PROBES:
        return PROBES[value]
    if inner[0] == _NUMBERS and all(map(math.isnan, value)):
        return None if is_optional else ()
    if is_dataclass(inner[0]):
        return _member(name, inner, _document(name, inner, value))
    if get_origin(inner[0]) is tuple and (kinds := get_args(get_args(inner[0])[0])):
        members = _document(name, kinds, value)
        if not isinstance(members, list):
            raise _not_json(name, kinds, value, "it is no list")
        return tuple(_member(name, kinds, one) for one in members)
    if isinstance(inner[0], type) and issubclass(inner[0], Enum):
        return _word(name, inner[0], value)
    return tuple(value) if get_origin(inner[0]) is tuple else value


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
    """The object that a JSON object stands for: of the only class, or of the one of a family that its kind tells."""
    try:
        numbers = dict(given)
        cls = kinds[0] if len(kinds) == 1 else {cls.kind: cls for cls in kinds}[numbers.pop("kind")]
        hints = get_type_hints(cls)
        found = cls(**numbers)
        return replace(found, **{key: _entry(f"{name}: {key}", hints[key], one) for key, one in numbers.items()})
    except InvalidArgument:  # a word of it
        raise
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise _not_json(name, kinds, given, error) from None


def _entry(name: str, kind: Any, value: Any) -> Any:
    """A value of an object. Raises TypeError or ValueError for what is no number, InvalidArgument for a word."""
    if isinstance(kind, type) and issubclass(kind, Enum):
        return _word(name, kind, value)
    if get_origin(kind) is tuple:
        return tuple(map(float, value))
    return operator.index(value) if kind is int else float(value)


def _not_json(name: str, kinds: Sequence[Any], given: Any, error: object) -> InvalidArgument:
    expected = ", ".join(item.name for item in fields(kinds[0]))
    if len(kinds) > 1:
        expected = f"a kind, one of {', '.join(cls.kind for cls in kinds)}, and its numbers"
    return InvalidArgument(f"{name} must be JSON with {expected}, got {given!r:.200} ({error})", field=name)

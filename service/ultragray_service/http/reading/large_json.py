"""Large JSON bodies, read in a thread in short steps, so that the event loop gets its turn in between.

A call of pydantic or `json` keeps every other thread waiting until it ends: what it is given is bounded first, and many
poses are checked one after another.
"""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from ultragray.contract import error_under
from ultragray.errors import InvalidArgument, UltragrayError
from ultragray_service.errors import BodyTooLarge

INLINE_BYTES = 64 * 1024  # of a body that is read at once: a few milliseconds
MAX_VALUES = 100_000  # of a body that has no limit of its own: about ten milliseconds
_MAX_DIGITS = 400  # of a number; one of a million takes long to read
_SMALL_VALUES, _ELEMENT_VALUES = 4096, 64
_DIGITS = bytes(b"0"[0] if chr(byte).isdecimal() and byte < 128 else b" "[0] for byte in range(256))

_READER = ThreadPoolExecutor(1, "large-bodies")  # one at a time: they share one lock of the interpreter

T = TypeVar("T")
ReadSmall = Callable[[str, Any], Any]


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


async def read_large(body: bytes, cls: type[T], apart: Apart | None, read_small: ReadSmall) -> T:
    """The body, checked as a small one would be. Raises BodyTooLarge, InvalidArgument and what the classes raise."""
    if apart is not None and len(body) > apart.max_bytes:
        raise BodyTooLarge(f"this body must be at most {apart.max_bytes} bytes, got {len(body)}", field="body")
    return await asyncio.get_running_loop().run_in_executor(_READER, _read, body, cls, apart, read_small)


def _read(body: bytes, cls: type[T], apart: Apart | None, read_small: ReadSmall) -> T:
    document = _decoded(body, MAX_VALUES if apart is None else apart.max_values)
    if apart is None or not isinstance(document, dict) or not isinstance(document.get(apart.key), apart.kind):
        return _small(document, cls, read_small)
    much = document[apart.key]
    rest: Any = _small({**document, apart.key: apart.kind()}, cls, read_small)
    if apart.element is not None:
        apart.check_count(len(much))
        much = [_element(apart, index, one, read_small) for index, one in enumerate(much)]
    whole: T = replace(rest, **{apart.key: much})
    return whole


def _decoded(body: bytes, max_values: float) -> Any:
    if body.count(b",") + body.count(b"[") + body.count(b"{") > max_values:
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


def _small(value: Any, cls: type[T], read_small: ReadSmall) -> T:
    if not _is_small(value, _SMALL_VALUES):
        raise InvalidArgument(f"the body must hold at most {_SMALL_VALUES} values beside its poses", field="body")
    read: T = read_small(json.dumps(value), cls)
    return read


def _element(apart: Apart, index: int, value: Any, read_small: ReadSmall) -> Any:
    path = f"{apart.key}[{index}]"
    if not _is_small(value, _ELEMENT_VALUES):
        raise apart.error(f"{path} must hold at most {_ELEMENT_VALUES} values", field=path)
    try:
        return read_small(json.dumps(value), apart.element)
    except UltragrayError as error:
        raise error_under(path, error, apart.error) from None


def _is_small(value: Any, most: int) -> bool:
    """Whether a value holds at most `most` others, and no long text."""
    waiting, values, characters = [value], 0, 0
    while waiting and values <= most and characters <= INLINE_BYTES:
        one = waiting.pop()
        values += 1
        if isinstance(one, str):
            characters += len(one)
        elif isinstance(one, dict):
            waiting += (*one, *one.values())
        elif isinstance(one, list):
            waiting += one
    return not waiting and values <= most and characters <= INLINE_BYTES

"""From what callers fill in to messages."""

from __future__ import annotations

from typing import Any, TypeVar

from ultragray_proto.codec import MessageInvalid, to_message

from .errors import InvalidArgument, UnknownOutput

M = TypeVar("M")

_ERRORS = {"outputs": UnknownOutput}  # by the field; all others are InvalidArgument


def message_of(value: Any, cls: type[M], **others: Any) -> M:
    """The message of a dataclass; `others` are fields that it does not have. The service checks the numbers.

    Raises InvalidArgument, or a kind of it, for a word that no message has.
    """
    try:
        return to_message(value, cls, **others)
    except MessageInvalid as error:
        field = error.field.partition("[")[0]
        raise _ERRORS.get(field, InvalidArgument)(str(error), field=field) from None

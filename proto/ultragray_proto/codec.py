"""One codec between dataclasses and messages, for the service and for its clients.

A field of a message and the attribute of the same name of a dataclass hold the same:

    dataclass                        message
    number, text, truth, bytes       the same
    enum, or word of a closed set    enum: "uint8" is ENCODING_UINT8
    sequence                         repeated
    sequence of numbers              message of as many numbers, in their order, such as Position
    array [4, 4]                     Matrix
    dict                             map; Struct; message that has the keys as fields
    dataclass                        message
    member of a family               oneof with a field for each kind, or message with a field `kind`

A family is a closed set of dataclasses told apart by their `kind`: a class with a dict `members`, or a union. Its oneof
has the name of the attribute, or is all there is in the attribute's message.

A value that a message leaves out is the dataclass's default, else None. Fields without presence are left out where they
are 0, empty or UNSPECIFIED; messages where they would say what the default of the dataclass says.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from functools import cache, partial, reduce
from operator import or_
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from google.protobuf.descriptor import Descriptor, EnumDescriptor, FieldDescriptor
from google.protobuf.struct_pb2 import Struct, Value

_M = TypeVar("_M")
_Convert = Callable[[Any], Any]

_STRUCT = "google.protobuf.Struct"
_MATRIX = "ultragray.v1.Matrix"
_WORD_START = re.compile(r"(?<!^)(?=[A-Z])")
_KEEP_DEFAULT, _REQUIRED = object(), object()


class MessageInvalid(ValueError):
    """A message that no dataclass can be made of, or a dataclass that no message can hold.

    `field` is the path of the value to blame, `problem` what is wrong with it. Where a dataclass refused its values,
    `original` is its error and `field` the path of the dataclass.
    """

    def __init__(self, problem: str, *, field: str = "", original: ValueError | None = None) -> None:
        super().__init__(f"{field} {problem}" if field else problem)
        self.problem = problem
        self.field = field
        self.original = original

    def under(self, prefix: str) -> MessageInvalid:
        """The same error as the message around sees it."""
        joint = "." if self.field and not self.field.startswith("[") else ""
        return MessageInvalid(self.problem, field=f"{prefix}{joint}{self.field}", original=self.original)


def to_message(value: Any, cls: type[_M], **others: Any) -> _M:
    """The message of a value. `others` are fields that the value does not have, or has in another form.

    Raises MessageInvalid for a word that its closed set does not have.
    """
    descriptor: Descriptor = cls.DESCRIPTOR  # type: ignore[attr-defined]
    return cls(**_fields_of(value, descriptor, frozenset(others)), **others)


def from_message(message: Any, cls: type[_M], **others: Any) -> _M:
    """The dataclass, or the member of a family, that a message tells. `others` are attributes that are known otherwise.

    Raises MessageInvalid.
    """
    annotation: Any = cls
    value: _M = _reader(message.DESCRIPTOR, annotation, frozenset(others))(message, **others)
    return value


@cache
def words(enum: EnumDescriptor) -> Mapping[int, str]:
    """The words of an enum by their numbers, but for UNSPECIFIED: "uint8" for ENCODING_UINT8."""
    prefix = f"{_WORD_START.sub('_', enum.name).upper()}_"
    return {one.number: one.name.removeprefix(prefix).lower() for one in enum.values if one.number != 0}


def _fields_of(value: Any, descriptor: Descriptor, others: frozenset[str] = frozenset()) -> dict[str, Any]:
    """The fields of a message that a value has, but for `others`."""
    if isinstance(value, Mapping):
        return _writer(frozenset(value), descriptor, others)(value.__getitem__)
    cls: Any = type(value)
    return _writer(cls, descriptor, others)(partial(getattr, value))


@cache
def _writer(cls: Any, descriptor: Descriptor, others: frozenset[str]) -> Callable[[_Convert], dict[str, Any]]:
    """Makes the fields of a message, but for `others`, from what gives a value by the name of its attribute or key.

    The names are those of a class, or a set of keys.
    """
    defaults = {one.name: one.default for one in fields(cls)} if is_dataclass(cls) else {}

    def has(name: str) -> bool:
        given = name in cls if isinstance(cls, frozenset) else name in defaults or hasattr(cls, name)
        return given and name not in others

    steps = [(one.name, _field_writer(one, defaults.get(one.name))) for one in descriptor.fields if has(one.name)]
    oneofs = [(name, _oneof_writer(kinds)) for name, kinds in _oneofs(descriptor).items() if has(name)]

    def write(get: _Convert) -> dict[str, Any]:
        found = {}
        for name, convert in steps:
            value = get(name)
            try:
                if value is not None and (value := convert(value)) is not None:
                    found[name] = value
            except MessageInvalid as error:
                raise error.under(name) from None
        for name, convert in oneofs:
            found |= convert(get(name))
        return found

    return write


def _field_writer(field: FieldDescriptor, default: Any) -> _Convert:
    if _is_map(field):
        return dict
    convert = _value_writer(field)
    if field.is_repeated:
        return lambda values: [convert(value) for value in values]
    if field.message_type is None or default is None or default is MISSING:
        return convert
    return lambda value: None if value == default else convert(value)


def _value_writer(field: FieldDescriptor) -> _Convert:
    if field.enum_type is not None:
        return _word_writer({word: number for number, word in words(field.enum_type).items()})
    descriptor = field.message_type
    if descriptor is None:
        return lambda value: value.value if isinstance(value, Enum) else value
    if descriptor.full_name == _STRUCT:
        return _struct_of
    if descriptor.full_name == _MATRIX:
        return lambda array: {"values": np.ravel(array).tolist()}
    if kinds := _only_oneof(descriptor):
        return _oneof_writer(kinds)
    names = [one.name for one in descriptor.fields]

    def convert(value: Any) -> Any:
        if isinstance(value, (tuple, list, np.ndarray)):
            return dict(zip(names, map(float, value), strict=True))
        return _fields_of(value, descriptor)

    return convert


def _word_writer(numbers: Mapping[str, int]) -> _Convert:
    def number(value: Any) -> int:
        word = value.value if isinstance(value, Enum) else value
        if word not in numbers:
            raise MessageInvalid(f"must be one of {', '.join(numbers)}, got {word!r}")
        return numbers[word]

    return number


def _oneof_writer(kinds: Mapping[str, Descriptor]) -> Callable[[Any], dict[str, Any]]:
    def convert(value: Any) -> dict[str, Any]:
        kind = value["kind"] if isinstance(value, Mapping) else value.kind
        return {kind: _fields_of(value, kinds[kind])}

    return convert


def _struct_of(values: Mapping[str, Any]) -> Struct:
    struct = Struct()
    struct.update(values)
    return struct


@cache
def _reader(descriptor: Descriptor, annotation: Any, others: frozenset[str] = frozenset()) -> Callable[..., Any]:
    """Reads a message as what an annotation says, but for the attributes `others`."""
    kind, _ = _optional_of(annotation)
    if descriptor.full_name == _STRUCT:
        return _dict_of
    if descriptor.full_name == _MATRIX:
        return lambda message: np.array(message.values, np.float64).reshape(4, 4)
    if (members := _members(kind)) is not None:
        if kinds := _only_oneof(descriptor):
            return _oneof_reader(descriptor.oneofs[0].name, kinds, members)
        return _flat_reader(descriptor, members)
    if get_origin(kind) is dict:
        return lambda message: {field.name: value for field, value in message.ListFields()}
    if get_origin(kind) is tuple:
        names = [one.name for one in descriptor.fields]
        return lambda message: tuple([getattr(message, name) for name in names])
    return _dataclass_reader(descriptor, kind, others)


def _dataclass_reader(descriptor: Descriptor, cls: Any, others: frozenset[str] = frozenset()) -> Callable[..., Any]:
    hints = get_type_hints(cls)
    known = {*descriptor.fields_by_name, *_oneofs(descriptor)} - others
    steps = [
        (one.name, _attribute_reader(descriptor, one, hints[one.name]))
        for one in fields(cls)
        if one.init and one.name in known
    ]

    def read(message: Any, **values: Any) -> Any:
        for name, step in steps:
            if name not in values and (value := step(message)) is not _KEEP_DEFAULT:
                values[name] = value
        try:
            return cls(**values)
        except ValueError as error:
            raise MessageInvalid(str(error), original=error) from error

    return read


def _attribute_reader(descriptor: Descriptor, attribute: Field[Any], annotation: Any) -> _Convert:
    """Reads an attribute from its field of a message; _KEEP_DEFAULT where that is left out."""
    name, (kind, is_optional) = attribute.name, _optional_of(annotation)
    left_out = None if is_optional else _REQUIRED
    if attribute.default is not MISSING or attribute.default_factory is not MISSING:
        left_out = _KEEP_DEFAULT
    if name not in descriptor.fields_by_name:
        read_member = _oneof_reader(name, _oneofs(descriptor)[name], _members(kind) or {})
        if left_out is _REQUIRED:
            return read_member
        return lambda message: left_out if message.WhichOneof(name) is None else read_member(message)
    field = descriptor.fields_by_name[name]
    convert = _field_reader(field, kind)

    def read(message: Any) -> Any:
        value = getattr(message, name)
        is_left_out = not message.HasField(name) if field.has_presence else not value
        if is_left_out and (left_out is not _REQUIRED or field.has_presence):
            if left_out is _REQUIRED:
                raise MessageInvalid("is required", field=name)
            return left_out
        try:
            return convert(value)
        except MessageInvalid as error:
            raise error.under(name) from error.original

    return read


def _field_reader(field: FieldDescriptor, kind: Any) -> _Convert:
    """Reads the value of a field as what an annotation without None says."""
    if _is_map(field):
        return dict
    if not field.is_repeated:
        return _value_reader(field, kind)
    container = get_origin(kind) or kind
    convert = _value_reader(field, get_args(kind)[0])
    if field.message_type is None:
        return lambda values: container([convert(value) for value in values])

    def read(messages: Any) -> Any:
        found = []
        for index, message in enumerate(messages):
            try:
                found.append(convert(message))
            except MessageInvalid as error:
                raise error.under(f"[{index}]") from error.original
        return container(found)

    return read


def _value_reader(field: FieldDescriptor, kind: Any) -> _Convert:
    if field.message_type is not None:
        return _reader(field.message_type, kind)
    if field.enum_type is None:
        return kind if isinstance(kind, type) and issubclass(kind, Enum) else lambda value: value
    enum = field.enum_type
    values = {one.value: one for one in kind} if isinstance(kind, type) and issubclass(kind, Enum) else None
    known = {
        number: word if values is None else values[word]
        for number, word in words(enum).items()
        if values is None or word in values
    }

    def read(number: int) -> Any:
        if number not in known:
            names = ", ".join(enum.values_by_number[one].name for one in known)
            raise MessageInvalid(f"must be {'some' if field.is_repeated else 'one'} of {names}, got number {number}")
        return known[number]

    return read


def _oneof_reader(name: str, kinds: Mapping[str, Descriptor], members: Mapping[str, Any]) -> Callable[..., Any]:
    """Reads the member of a family that a oneof holds."""

    def read(message: Any, **others: Any) -> Any:
        kind = message.WhichOneof(name)
        if kind not in members:
            raise MessageInvalid(f"must be one of {', '.join(members)}, got {kind or 'none'}", field=name)
        try:
            return _reader(kinds[kind], members[kind])(getattr(message, kind), **others)
        except MessageInvalid as error:
            raise error.under(kind) from error.original

    return read


def _flat_reader(descriptor: Descriptor, members: Mapping[str, Any]) -> Callable[..., Any]:
    """Reads the member of a family from a message that has the fields of all of them."""

    def read(message: Any, **others: Any) -> Any:
        if message.kind not in members:
            raise MessageInvalid(f"must be one of {', '.join(members)}, got {message.kind!r}", field="kind")
        member = members[message.kind]
        takes = {one.name for one in fields(member)} | {"kind"}
        for field, _ in message.ListFields():
            if field.name not in takes:
                raise MessageInvalid(f"must be left out: kind {message.kind} does not take it", field=field.name)
        return _reader_of_member(descriptor, member)(message, **others)

    return read


_reader_of_member = cache(_dataclass_reader)


def _dict_of(struct: Struct) -> dict[str, Any]:
    """A Struct holds every number as a double: those without a fraction become integers again."""
    found = {}
    for name, value in struct.fields.items():
        try:
            found[name] = _plain(value)
        except MessageInvalid as error:
            raise error.under(name) from None
    return found


def _plain(value: Value) -> Any:
    kind = value.WhichOneof("kind")
    if kind == "number_value":
        number = value.number_value
        if not math.isfinite(number):
            raise MessageInvalid(f"must be a finite number, got {number}")
        return int(number) if number.is_integer() else number
    if kind == "struct_value":
        return _dict_of(value.struct_value)
    if kind == "list_value":
        return [_plain(one) for one in value.list_value.values]
    return None if kind in ("null_value", None) else getattr(value, kind)


# What descriptors and annotations say.


def _is_map(field: FieldDescriptor) -> bool:
    return field.message_type is not None and field.message_type.GetOptions().map_entry


def _oneofs(descriptor: Descriptor) -> dict[str, dict[str, Descriptor]]:
    """The oneofs of messages, not those that proto3 makes of `optional`: the messages by the names of their fields."""
    return {
        one.name: {field.name: field.message_type for field in one.fields}
        for one in descriptor.oneofs
        if all(field.message_type is not None for field in one.fields)
    }


def _only_oneof(descriptor: Descriptor) -> dict[str, Descriptor] | None:
    """The oneof of a message that has nothing else."""
    kinds = next(iter(_oneofs(descriptor).values()), None)
    return kinds if kinds is not None and len(kinds) == len(descriptor.fields) else None


def _optional_of(annotation: Any) -> tuple[Any, bool]:
    """The type that an annotation allows beside None, and whether it allows None."""
    if get_origin(annotation) not in (Union, UnionType):
        return annotation, False
    kinds = [one for one in get_args(annotation) if one is not NoneType]
    return reduce(or_, kinds), len(kinds) < len(get_args(annotation))


def _members(kind: Any) -> Mapping[str, Any] | None:
    """The classes of a family by their kinds."""
    if get_origin(kind) in (Union, UnionType):
        return {one.kind: one for one in get_args(kind)}
    members = None if isinstance(getattr(kind, "kind", None), str) else getattr(kind, "members", None)
    return members if isinstance(members, dict) else None

"""One codec between dataclasses and messages, for the service and for its clients: by names and descriptors alone.

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

What a pair of a class and a descriptor needs is worked out once: `_writers` and `_reader` give the steps of it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, fields, is_dataclass
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

_STRUCT, _MATRIX = "google.protobuf.Struct", "ultragray.v1.Matrix"
_WORD_START = re.compile(r"(?<!^)(?=[A-Z])")
_LEFT_OUT = object()  # in place of a value: the dataclass keeps its default


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
    return cls(**_written(descriptor, value, others))


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


def _at(path: str, convert: _Convert, value: Any) -> Any:
    """What `convert` makes of the value at a path. Raises MessageInvalid with the path."""
    try:
        return convert(value)
    except MessageInvalid as error:
        raise error.under(path) from error.original


# From a dataclass to a message: the keyword arguments of its class.


def _written(descriptor: Descriptor, value: Any, others: Mapping[str, Any] | None = None) -> dict[str, Any]:
    found = dict(others) if others else {}
    cls: Any = type(value)
    is_mapping, steps, oneofs = _writers(descriptor, cls)
    for name, convert, default in steps:
        one = value.get(name) if is_mapping else getattr(value, name, None)
        if one is None or name in found or (default is not None and one == default):
            continue
        if convert is not None:
            try:
                one = convert(one)
            except MessageInvalid as error:
                raise error.under(name) from error.original
        found[name] = one
    for name, kinds in oneofs:
        one = value.get(name) if is_mapping else getattr(value, name, None)
        if one is not None and kinds.keys().isdisjoint(found):
            found |= _member_written(kinds, one)
    return found


@cache
def _writers(descriptor: Descriptor, cls: type) -> tuple[bool, tuple[Any, ...], tuple[Any, ...]]:
    """What is written of a class, and whether it is a mapping.

    Each field that it may have, how its value is written (None: as it is), and the default that leaves a message out,
    None where there is none; then the oneofs.
    """
    found = []
    for field in descriptor.fields:
        if not _may_have(cls, field.name):
            continue
        convert = dict if _is_map(field) else _value_writer(field)
        is_message = field.message_type is not None and not field.is_repeated
        if field.is_repeated and not _is_map(field):
            convert = list if convert is None else partial(_list_of, convert)
        found.append((field.name, convert, getattr(cls, field.name, None) if is_message else None))
    oneofs = tuple(one for one in _oneofs(descriptor).items() if _may_have(cls, one[0]))
    return issubclass(cls, Mapping), tuple(found), oneofs


def _may_have(cls: type, name: str) -> bool:
    """Whether values of a class may have an attribute; of one that is no dataclass, nobody knows."""
    return not is_dataclass(cls) or name in cls.__dataclass_fields__ or hasattr(cls, name)


def _list_of(convert: _Convert, values: Iterable[Any]) -> list[Any]:
    return [convert(value) for value in values]


def _value_writer(field: FieldDescriptor) -> _Convert | None:
    """How one value of a field is written; None: as it is."""
    descriptor = field.message_type
    if field.enum_type is not None:
        return partial(_number_of_word, {word: number for number, word in words(field.enum_type).items()})
    if descriptor is None:
        if field.type != FieldDescriptor.TYPE_STRING:
            return None
        return lambda value: value.value if isinstance(value, Enum) else value
    if descriptor.full_name == _STRUCT:
        return _struct_of
    if descriptor.full_name == _MATRIX:
        return lambda array: {"values": np.ravel(array).tolist()}
    if kinds := _only_oneof(descriptor):
        return partial(_member_written, kinds)
    names = [one.name for one in descriptor.fields]

    def convert(value: Any) -> Any:
        if isinstance(value, (tuple, list, np.ndarray)):
            return dict(zip(names, map(float, value), strict=True))
        return _written(descriptor, value)

    return convert


def _number_of_word(numbers: Mapping[str, int], value: Any) -> int:
    word = value.value if isinstance(value, Enum) else value
    if word not in numbers:
        raise MessageInvalid(f"must be one of {', '.join(numbers)}, got {word!r}")
    return numbers[word]


def _member_written(kinds: Mapping[str, Descriptor], value: Any) -> dict[str, Any]:
    kind = value["kind"] if isinstance(value, Mapping) else value.kind
    return {kind: _written(kinds[kind], value)}


def _struct_of(values: Mapping[str, Any]) -> Struct:
    struct = Struct()
    struct.update(values)
    return struct


# From a message to a dataclass.


@cache
def _reader(descriptor: Descriptor, annotation: Any, known: frozenset[str] = frozenset()) -> Callable[..., Any]:
    """Reads a message as what an annotation says; attributes that are `known` otherwise are its keyword arguments."""
    kind, _ = _optional_of(annotation)
    if descriptor.full_name == _STRUCT:
        return _dict_of
    if descriptor.full_name == _MATRIX:
        return lambda message: np.array(message.values, np.float64).reshape(4, 4)
    if (members := _members(kind)) is not None:
        if kinds := _only_oneof(descriptor):
            return partial(_read_member, descriptor.oneofs[0].name, kinds, members)
        return partial(_read_flat_member, members, known)
    if get_origin(kind) is dict:
        return lambda message: {field.name: value for field, value in message.ListFields()}
    if get_origin(kind) is tuple:
        names = [one.name for one in descriptor.fields]
        return lambda message: tuple([getattr(message, name) for name in names])
    return _dataclass_reader(descriptor, kind, known)


@cache
def _dataclass_reader(descriptor: Descriptor, cls: Any, known: frozenset[str]) -> Callable[..., Any]:
    hints, oneofs = get_type_hints(cls), _oneofs(descriptor)
    of_fields, of_oneofs = [], []
    for one in fields(cls):
        kind, is_optional = _optional_of(hints[one.name])
        has_default = one.default is not MISSING or one.default_factory is not MISSING
        left_out = _LEFT_OUT if has_default else None
        is_required = not has_default and not is_optional
        if not one.init or one.name in known:
            continue
        if (field := descriptor.fields_by_name.get(one.name)) is not None:
            convert = _values_reader(field, kind)
            of_fields.append((one.name, field.has_presence, is_required, left_out, convert))
        elif one.name in oneofs:
            members = partial(_read_member, one.name, oneofs[one.name], _members(kind) or {})
            of_oneofs.append((one.name, is_required, left_out, members))

    def read(message: Any, **values: Any) -> Any:
        for name, has_presence, is_required, left_out, convert in of_fields:  # all in one loop: frames have many
            value = getattr(message, name)
            if not (message.HasField(name) if has_presence else value):
                if not is_required:
                    if left_out is not _LEFT_OUT:
                        values[name] = left_out
                    continue
                if has_presence:
                    raise MessageInvalid("is required", field=name)
            if convert is not None:
                try:
                    value = convert(value)
                except MessageInvalid as error:
                    raise error.under(name) from error.original
            values[name] = value
        for name, is_required, left_out, read_member in of_oneofs:
            if is_required or message.WhichOneof(name) is not None:
                values[name] = read_member(message)
            elif left_out is not _LEFT_OUT:
                values[name] = left_out
        try:
            return cls(**values)
        except ValueError as error:
            raise MessageInvalid(str(error), original=error) from error

    return read


def _values_reader(field: FieldDescriptor, kind: Any) -> _Convert | None:
    """Makes of a field's value, or values, what an annotation without None says; None: they are that."""
    if _is_map(field):
        return dict
    if not field.is_repeated:
        return _value_reader(field, kind)
    container: _Convert = get_origin(kind) or kind
    if (convert := _value_reader(field, get_args(kind)[0])) is None:
        return container
    if field.message_type is None:
        return lambda values: container([convert(value) for value in values])
    return lambda values: container([_at(f"[{index}]", convert, value) for index, value in enumerate(values)])


def _value_reader(field: FieldDescriptor, kind: Any) -> _Convert | None:
    is_enum = isinstance(kind, type) and issubclass(kind, Enum)
    if field.message_type is not None:
        return _reader(field.message_type, kind)
    if field.enum_type is None:
        return kind if is_enum else None
    enum, values = field.enum_type, {one.value: one for one in kind} if is_enum else None
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


def _read_member(
    name: str, kinds: Mapping[str, Descriptor], members: Mapping[str, Any], message: Any, **others: Any
) -> Any:
    """The member of a family that the oneof of a name holds."""
    kind = message.WhichOneof(name)
    if kind not in members:
        raise MessageInvalid(f"must be one of {', '.join(members)}, got {kind or 'none'}", field=name)
    read = _reader(kinds[kind], members[kind], frozenset(others))
    return _at(kind, partial(read, **others), getattr(message, kind))


def _read_flat_member(members: Mapping[str, Any], known: frozenset[str], message: Any, **others: Any) -> Any:
    """The member of a family that a message tells which has the fields of all of them."""
    if message.kind not in members:
        raise MessageInvalid(f"must be one of {', '.join(members)}, got {message.kind!r}", field="kind")
    member = members[message.kind]
    takes = {one.name for one in fields(member)} | {"kind"}
    for field, _ in message.ListFields():
        if field.name not in takes:
            raise MessageInvalid(f"must be left out: kind {message.kind} does not take it", field=field.name)
    return _dataclass_reader(message.DESCRIPTOR, member, known)(message, **others)


def _dict_of(struct: Struct) -> dict[str, Any]:
    """A Struct holds every number as a double: those without a fraction become integers again."""
    return {name: _at(name, _plain, value) for name, value in struct.fields.items()}


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


@cache
def _oneofs(descriptor: Descriptor) -> Mapping[str, Mapping[str, Descriptor]]:
    """The oneofs of messages, not those that proto3 makes of `optional`: the messages by the names of their fields."""
    return {
        one.name: {field.name: field.message_type for field in one.fields}
        for one in descriptor.oneofs
        if all(field.message_type is not None for field in one.fields)
    }


def _only_oneof(descriptor: Descriptor) -> Mapping[str, Descriptor] | None:
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

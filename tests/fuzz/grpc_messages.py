"""Messages of a descriptor, field by field, as hypothesis strategies."""

import struct

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message_factory import GetMessageClass
from hypothesis import strategies as st

from .mutations import NUMBERS, REALS, TEXTS

MOST_REPEATED = 4
MOST_DEEP = 5
NAMES = ("demo", "second", "probeless", "absent", *TEXTS)

_RANGES = {
    FieldDescriptor.CPPTYPE_INT32: (-(2**31), 2**31 - 1),
    FieldDescriptor.CPPTYPE_INT64: (-(2**63), 2**63 - 1),
    FieldDescriptor.CPPTYPE_UINT32: (0, 2**32 - 1),
    FieldDescriptor.CPPTYPE_UINT64: (0, 2**64 - 1),
}


def messages(descriptor, depth=0):
    """Any message of the type; fields are often absent."""
    fields = {field.name: _field(field, depth) for field in descriptor.fields if depth < MOST_DEEP}
    chosen = st.fixed_dictionaries({}, optional=fields)
    return chosen.map(lambda values: _made(descriptor, values))


def near(valid, depth=0):
    """A message like a valid one, in which some fields, at any depth, are others or are gone."""

    def apply(changes):
        changed = type(valid)()
        changed.CopyFrom(valid)
        for name, value in changes.items():
            changed.ClearField(name)
            _set(changed, name, value)
        return changed

    fields = {}
    for field in valid.DESCRIPTOR.fields:
        other = _field(field, depth + 1)
        if field.message_type is not None and not field.is_repeated and valid.HasField(field.name):
            other = st.one_of(near(getattr(valid, field.name), depth + 1), other)
        fields[field.name] = st.one_of(other, st.none())
    names = st.lists(st.sampled_from(sorted(fields)), max_size=2, unique=True) if fields else st.just([])
    return names.flatmap(lambda chosen: st.fixed_dictionaries({name: fields[name] for name in chosen})).map(apply)


def _made(descriptor, values):
    message = GetMessageClass(descriptor)()
    for name, value in values.items():
        _set(message, name, value)
    return message


def _set(message, name, value):
    field = message.DESCRIPTOR.fields_by_name[name]
    if value is None:
        return
    if field.message_type is not None and field.message_type.GetOptions().map_entry:
        for entry in value:
            target = getattr(message, name)
            if field.message_type.fields_by_name["value"].message_type is None:
                target[entry.key] = entry.value
            else:
                target[entry.key].CopyFrom(entry.value)
    elif field.is_repeated:
        getattr(message, name).extend(value)
    elif field.message_type is not None:
        getattr(message, name).CopyFrom(value)
    else:
        setattr(message, name, value)


def _field(field, depth):
    one = _value(field, depth)
    return st.lists(one, max_size=MOST_REPEATED) if field.is_repeated else one


def _value(field, depth):
    match field.cpp_type:
        case FieldDescriptor.CPPTYPE_MESSAGE:
            return st.deferred(lambda: messages(field.message_type, depth + 1))
        case FieldDescriptor.CPPTYPE_STRING if field.type == FieldDescriptor.TYPE_BYTES:
            return st.binary(max_size=200)
        case FieldDescriptor.CPPTYPE_STRING:
            texts = [text for text in NAMES if text.isprintable() or text == "\0"]
            return st.one_of(st.sampled_from(texts), st.sampled_from(texts), st.text(max_size=30))
        case FieldDescriptor.CPPTYPE_DOUBLE:
            return st.one_of(st.sampled_from(REALS), st.floats(), st.floats(-60.0, 60.0))
        case FieldDescriptor.CPPTYPE_FLOAT:
            return st.floats(width=struct.calcsize("f") * 8)
        case FieldDescriptor.CPPTYPE_BOOL:
            return st.booleans()
        case FieldDescriptor.CPPTYPE_ENUM:
            known = [value.number for value in field.enum_type.values]
            return st.one_of(st.sampled_from(known), st.sampled_from(known), st.integers(-1, 99))
        case kind:
            low, high = _RANGES[kind]
            known = [number for number in NUMBERS if low <= number <= high]
            return st.one_of(st.integers(0, 64), st.sampled_from(known), st.integers(low, high))

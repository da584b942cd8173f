"""The contract's dataclasses: each field says what it means and what it may be, once, for every door.

    @dataclass(frozen=True)
    class Display(Contract):
        gain_db: float = described("Added to every echo.", 0.0, low=-100.0, high=100.0)

The checks of the values, help texts, the OpenAPI document, the tables of the documentation and the generated code of
clients are made of these fields. JSON has the names and values of the fields; a member of a `Family` (a closed set,
such as the probes) is told apart by its `kind`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, Field, field, fields, is_dataclass
from enum import Enum
from functools import cache, partial
from operator import is_
from pathlib import Path, PurePath
from types import MappingProxyType, NoneType, UnionType
from typing import Annotated, Any, ClassVar, Literal, NoReturn, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from ultragray.errors import InvalidArgument, UltragrayError

_T = TypeVar("_T")
_SHOWN_CHARACTERS = 100
_SHOWN_ELEMENTS = 50
_BOOLEANS = {"true": True, "1": True, "yes": True, "on": True, "false": False, "0": False, "no": False, "off": False}


def described(
    meaning: str,
    default: Any = MISSING,
    *,
    factory: Any = MISSING,
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    choices: tuple[str, ...] | None = None,
    most: int | None = None,
    error: type[InvalidArgument] | None = None,
    example: Any = None,
    topic: str | None = None,
    schema: Mapping[str, Any] | None = None,
    **options: Any,
) -> Any:
    """A dataclass field that says what it means.

    A number must lie from `low` (or above `above`) to `high`; a word must be one of `choices`, a list may have `most`
    elements, each within the limits. `error`: what is raised instead of the error of the class. `example`: a value of a
    usual member of a family. `topic`: the heading under which a help lists it, where that is not the class's.
    `schema`: what else its JSON Schema says. `options` are those of `dataclasses.field`.
    """
    metadata: dict[str, Any] = {"description": meaning}
    limits = {"low": low, "high": high, "above": above, "choices": choices, "most": most, "error": error}
    metadata |= {
        name: fact for name, fact in {**limits, "example": example, "topic": topic}.items() if fact is not None
    }
    words = _schema(**limits) | dict(schema or {})
    if choices is not None and default is None:
        words["enum"] = [*choices, None]
    if words:
        metadata["json_schema_extra"] = words  # the key that pydantic reads
    return field(default=default, default_factory=factory, metadata=metadata, **options)


def _schema(**limits: Any) -> dict[str, Any]:
    """The limits of a field in the words of JSON Schema; those of a list's elements stand under `items`."""
    words = {"low": "minimum", "high": "maximum", "above": "exclusiveMinimum", "choices": "enum"}
    schema = {word: limits[name] for name, word in words.items() if limits[name] is not None}
    if limits["most"] is None:
        return schema
    return {"maxItems": limits["most"], **({"items": {"type": "number", **schema}} if schema else {})}


class Contract:
    """Base of the contract's frozen dataclasses: checks each field by its annotation and its limits.

    Raises `error` (InvalidArgument, or a subclass of it that the class names) with the name of the field.
    """

    error: ClassVar[type[InvalidArgument]] = InvalidArgument
    __topic__: ClassVar[str | None] = None  # the heading under which a help lists the fields
    # Read by pydantic, which the service checks JSON with: values are taken at their word.
    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid", "strict": True, "allow_inf_nan": False}

    def __post_init__(self) -> None:
        cls: Any = type(self)
        for name, default, check, error in _checks(cls):
            value = getattr(self, name)
            if value is default:
                continue
            try:
                checked = check(value)
            except UltragrayError as inner:
                raise error_under(name, inner, error) from None
            if checked is not value:
                object.__setattr__(self, name, checked)


class Family(Contract):
    """Base of a closed set of contract dataclasses: `class Probe(Family)`, `class LinearProbe(Probe)`.

    A member is told apart by its field `kind: Literal["linear"] = kind_field("linear")`. Members register by being
    defined.
    """

    members: ClassVar[dict[str, type[Any]]]
    named: ClassVar[Mapping[str, Any]] = MappingProxyType({})  # members that have a name, which stands for their JSON

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if Family in cls.__bases__:
            cls.members = {}
        elif isinstance(kind := cls.__dict__.get("kind"), Field):
            cls.members[str(kind.default)] = cls

    @classmethod
    def __get_pydantic_json_schema__(cls, source: Any, handler: Any) -> Any:
        """The JSON Schema of a member: its kind is required, and there is an example of it."""
        document = handler(source)
        if Family not in cls.__bases__:
            schema = handler.resolve_ref_schema(document)
            schema["required"] = ["kind", *schema.get("required", ())]
            if examples := cls.example():
                schema["examples"] = [{"kind": schema["properties"]["kind"]["const"], **examples}]
        return document

    @classmethod
    def example(cls) -> dict[str, Any]:
        """The values of a usual member; empty where its fields give none."""
        return {item.name: item.metadata["example"] for item, _ in annotated_fields(cls) if "example" in item.metadata}

    @classmethod
    def member(cls: type[_T], kind: Any) -> type[_T]:
        """The class of a kind. Raises the family's error for an unknown one, naming the field `kind`."""
        members: dict[str, type[_T]] = cls.members  # type: ignore[attr-defined]  # cls is a Family
        if not isinstance(kind, str) or kind not in members:
            error: type[InvalidArgument] = cls.error  # type: ignore[attr-defined]
            raise error(f"kind must be one of {', '.join(members)}, got {shown(kind)}", field="kind")
        return members[kind]

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> Any:
        """The schema by which pydantic reads the family, as the member that `kind` names."""
        if Family not in cls.__bases__:
            return handler(source)
        from pydantic import BeforeValidator, Discriminator  # called by pydantic only

        union: Any = Union.__getitem__(tuple(cls.members.values()))
        if not cls.named:
            return handler.generate_schema(Annotated[union, Discriminator("kind")])
        return handler.generate_schema(Annotated[union, Discriminator("kind"), BeforeValidator(cls._spelled_out)])

    @classmethod
    def _spelled_out(cls, document: Any) -> Any:
        """The JSON of a member: of the one that has this name, else as given. Raises the family's error."""
        if not isinstance(document, str):
            return document
        if document not in cls.named:
            names = ", ".join(cls.named)
            raise cls.error(f"must be an object or one of {names}, got {shown(document)}")
        return to_dict(cls.named[document])


def kind_field(kind: str) -> Any:
    return field(default=kind, repr=False, kw_only=True, metadata={"description": "Always the same."})


def annotated_fields(cls: Any) -> tuple[tuple[Field[Any], Any], ...]:
    """The fields of a dataclass that are given when it is made, each with its annotation as a type."""
    return _annotated_fields(cls)  # mypy takes no class for what a cache can hold


@cache
def _annotated_fields(cls: Any) -> tuple[tuple[Field[Any], Any], ...]:
    hints = get_type_hints(cls)
    return tuple((item, hints[item.name]) for item in fields(cls) if item.init)


def made_of(cls: type[_T], *sources: object, **others: Any) -> _T:
    """The dataclass with `others`, and with what sources have under the names of its fields, the first that has one."""
    one: Any = cls
    names = [item.name for item in fields(one) if item.init and item.name not in others]
    values = {name: getattr(source, name) for name in names for source in sources[::-1] if hasattr(source, name)}
    return cls(**values, **others)


def optional_of(annotation: Any) -> tuple[Any, bool]:
    """The type that an annotation allows beside None, and whether it allows None."""
    if get_origin(annotation) in (Union, UnionType):
        types = [one for one in get_args(annotation) if one is not NoneType]
        if len(types) == 1:
            return types[0], len(get_args(annotation)) == 2
    return annotation, False


def from_text(text: str, annotation: Any) -> Any:
    """A value that a person wrote, such as an environment variable: lists with commas, booleans as `true` or `1`.

    What cannot be read stays a text, so that the check of its field says what was expected.
    """
    kind, _ = optional_of(annotation)
    if get_origin(kind) is tuple:
        return tuple(from_text(word.strip(), get_args(kind)[0]) for word in text.split(",") if word.strip())
    if kind is bool:
        return _BOOLEANS.get(text.strip().lower(), text)
    try:
        return kind(text) if kind in (int, float, Path) else text
    except ValueError:
        return text


def to_dict(value: Any, *, with_none: bool = True) -> Any:
    """A contract dataclass as JSON holds it: `{"kind": "convex", "opening_angle_deg": 60.0, …}`."""
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, (list, tuple)):
        return [to_dict(item, with_none=with_none) for item in value]
    if not is_dataclass(value) or isinstance(value, type):
        return value
    cls: Any = type(value)
    entries = {name: to_dict(getattr(value, name), with_none=with_none) for name in _keys(cls)}
    return entries if with_none else {name: one for name, one in entries.items() if one is not None}


@cache
def _keys(cls: Any) -> tuple[str, ...]:
    """The keys of a dataclass in JSON, `kind` first."""
    return tuple(sorted((item.name for item in fields(cls) if item.init), key=lambda name: name != "kind"))


def from_dict(cls: type[_T], document: Any) -> _T:
    """Inverse of `to_dict`; what is left out keeps its default.

    Raises the error of the class, with a path as its field, for unknown and missing keys and for values that cannot be.
    """
    error: type[InvalidArgument] = getattr(cls, "error", InvalidArgument)
    if issubclass(cls, Family) and cls.named:
        document = cls._spelled_out(document)
    if not isinstance(document, Mapping):
        raise error(f"must be an object, got {shown(document)}")
    is_family = issubclass(cls, Family)
    if is_family and Family in cls.__bases__:
        cls = cls.member(document.get("kind"))  # type: ignore[attr-defined]
    known = {item.name: (item, annotation) for item, annotation in annotated_fields(cls)}
    takes_none = {name for name, (_, annotation) in known.items() if optional_of(annotation)[1]}
    left_out = {name for name, value in document.items() if value is None and name in known.keys() - takes_none}
    document = {name: value for name, value in document.items() if name not in left_out}
    for name in document:
        if name not in known:
            takes = ", ".join(one for one in known if one != "kind") or "nothing"
            name = str(name)[:_SHOWN_CHARACTERS]
            raise error(f"{name} is not a known key: {_title(cls)} takes {takes}", field=name)
    for name, (item, _) in known.items():
        if name not in document and item.default is MISSING and item.default_factory is MISSING:
            raise error(f"{name} is required by {_title(cls)}", field=name)
    values = {}
    for name, value in document.items():
        with under(name, error):
            values[name] = _read(value, known[name][1])
    return cls(**values)


def blamed(cls: Any, location: Iterable[str | int]) -> tuple[str, type[InvalidArgument], Any]:
    """The path of a value below a contract class, the error for it, and its type.

    The error is that of the field, else of the class around it.

    The location may also name the members of families on the way, as pydantic does.
    """
    path, error = "", getattr(cls, "error", InvalidArgument)
    for part in location:
        if part in getattr(cls, "members", ()):
            cls = cls.members[part]
            continue
        path = join(path, f"[{part}]" if isinstance(part, int) else part)
        if get_origin(cls) in (list, tuple):
            cls, _ = optional_of(get_args(cls)[0])
        elif is_dataclass(cls):
            for item, annotation in annotated_fields(cls):
                if item.name == part:
                    cls, _ = optional_of(annotation)
                    error = item.metadata.get("error", getattr(cls, "error", error))
                    break
    return path, error, cls


def _title(cls: Any) -> str:
    """A class as messages say it: "the sampler around" of a member of the family `Sampler`."""
    family = next((one for one in cls.__mro__ if Family in one.__bases__), None)
    return cls.__name__ if family is None else f"the {family.__name__.lower()} {cls.kind}"


def _read(value: Any, annotation: Any) -> Any:
    kind, _ = optional_of(annotation)
    if value is not None and isinstance(kind, type) and (is_dataclass(kind) or issubclass(kind, Family)):
        return from_dict(kind, value)
    element = get_args(kind)[0] if get_origin(kind) is tuple and isinstance(value, (list, tuple)) else None
    if not isinstance(element, type) or not issubclass(element, Contract):
        return value
    elements = []
    for place, one in enumerate(value):
        with under(f"[{place}]"):
            elements.append(from_dict(element, one))
    return tuple(elements)


_Check = Callable[[Any], Any]  # the value in its own type; raises InvalidArgument


@cache
def _checks(cls: type[Contract]) -> tuple[tuple[str, Any, _Check, type[InvalidArgument]], ...]:
    """Each field's name, its default in its own type, which needs no check, its check, and the error of that."""
    checks = []
    for item, annotation in annotated_fields(cls):
        kind, optional = optional_of(annotation)
        check = _check_of_kind(kind, item)
        if optional or item.default is None:
            check = partial(_unless_none, check)
        default = MISSING if item.default is MISSING else check(item.default)
        checks.append((item.name, default, check, item.metadata.get("error", cls.error)))
    return tuple(checks)


def _check_of_kind(kind: Any, item: Field[Any]) -> _Check:
    limit = item.metadata.get
    if get_origin(kind) is Literal:
        return partial(_word, get_args(kind))
    if get_origin(kind) is tuple:
        elements = get_args(kind)
        count = None if Ellipsis in elements else len(elements)
        return partial(_list, _check_of_kind(elements[0], item), limit("most"), count)
    if get_origin(kind) is dict:
        return partial(_object, limit("most"))
    if not isinstance(kind, type):
        return _any
    if issubclass(kind, Enum):
        return partial(_enum, kind)
    if kind in (int, float):
        return partial(checked_number, kind=kind, low=limit("low"), high=limit("high"), above=limit("above"))
    if kind is str:
        return partial(_text, limit("choices"))
    if kind is bool:
        return partial(_instance, (bool, np.bool_), "true or false")
    return partial(_instance, kind, f"a {kind.__name__}") if issubclass(kind, Contract) else _any


def _any(value: Any) -> Any:
    return value


def _unless_none(check: _Check, value: Any) -> Any:
    return None if value is None else check(value)


def _word(words: tuple[Any, ...], value: Any) -> Any:
    return value if value in words else _refuse(f"one of {', '.join(map(str, words))}", value)


def _list(check: _Check, most: int | None, count: int | None, value: Any) -> tuple[Any, ...]:
    if not isinstance(value, (list, tuple)):
        _refuse("a list", value)
    if most is not None and len(value) > most:
        _refuse(f"a list of at most {most} values", len(value))
    if count is not None and len(value) != count:
        _refuse(f"a list of {count} values", value)
    checked = []
    for index, one in enumerate(value):
        with under(f"[{index}]"):
            checked.append(check(one))
    if isinstance(value, tuple) and all(map(is_, checked, value)):
        return value
    return tuple(checked)


def _object(most: int | None, value: Any) -> dict[Any, Any]:
    if not isinstance(value, dict):
        _refuse("an object", value)
    return value if most is None or len(value) <= most else _refuse(f"an object of at most {most} entries", len(value))


def _enum(kind: type[Enum], value: Any) -> Enum:
    try:
        return kind(value)
    except ValueError:
        _refuse(f"one of {', '.join(one.value for one in kind)}", value)


def _text(choices: tuple[str, ...] | None, value: Any) -> str:
    if not isinstance(value, str):
        _refuse("a text", value)
    return value if choices is None or value in choices else _refuse(f"one of {', '.join(choices)}", value)


def _instance(kind: Any, expected: str, value: Any) -> Any:
    return value if isinstance(value, kind) else _refuse(expected, value)


def checked_number(
    value: Any, kind: type, *, low: float | None = None, high: float | None = None, above: float | None = None
) -> int | float:
    """The number as an int or a float. Raises InvalidArgument for one beyond the limits, and for what is none."""
    is_number = isinstance(value, (int, np.integer) if kind is int else (int, float, np.integer, np.floating))
    number: int | float = math.nan
    if is_number and not isinstance(value, bool):
        try:
            number = int(value) if kind is int else float(value)
        except OverflowError:  # an int of hundreds of digits
            number = math.inf
    is_finite = isinstance(number, int) or math.isfinite(number)
    fits = is_finite and (low is None or number >= low) and (high is None or number <= high)
    if not fits or (above is not None and number <= above):
        _refuse(f"{'an integer' if kind is int else 'a finite number'}{_range(low, high, above)}", value)
    return number


def range_of(item: Field[Any]) -> str:
    """The limits of a field's numbers in words, such as " from 0 to 1"; empty where there are none."""
    return _range(*(item.metadata.get(name) for name in ("low", "high", "above")))


def limits_in_words(item: Field[Any]) -> str:
    """The limits of a field, such as "From 0 to 1"; empty where there are none."""
    limit = item.metadata.get
    words = [_range(limit("low"), limit("high"), limit("above")).strip()]
    if (choices := limit("choices")) is not None:
        words.append(f"one of {', '.join(choices)}")
    if (most := limit("most")) is not None:
        words.append(f"at most {most} values")
    joined = ", ".join(word for word in words if word)
    return joined[:1].upper() + joined[1:]


def _range(low: float | None, high: float | None, above: float | None) -> str:
    """The limits in words, beginning with a space; empty where there are none."""
    if low is not None:
        return f" from {_plain(low)} to {_plain(high)}" if high is not None else f" of at least {_plain(low)}"
    if above is not None:
        return f" above {_plain(above)}" + (f" and at most {_plain(high)}" if high is not None else "")
    return "" if high is None else f" of at most {_plain(high)}"


def _plain(limit: float) -> str:
    return str(limit) if isinstance(limit, int) else f"{limit:g}"


def _refuse(expected: str, value: Any) -> NoReturn:
    raise InvalidArgument(f"must be {expected}, got {shown(value)}")


def shown(value: Any) -> str:
    """A value in a message, cut where it is long: as JSON writes it, but for the quotes of a text."""
    text = _in_words(value)
    return text if len(text) <= _SHOWN_CHARACTERS else f"{text[:_SHOWN_CHARACTERS]}…"


def _in_words(value: Any) -> str:
    if isinstance(value, Enum):
        return _in_words(value.value)
    if isinstance(value, (list, tuple)):
        if len(value) > _SHOWN_ELEMENTS:
            return f"a list of {len(value)} values"
        return f"[{', '.join(map(_in_words, value))}]"
    if isinstance(value, Mapping):
        if len(value) > _SHOWN_ELEMENTS:
            return f"an object of {len(value)} entries"
        return f"{{{', '.join(f'{_in_words(key)}: {_in_words(one)}' for key, one in value.items())}}}"
    if value is None or isinstance(value, (bool, np.bool_)):
        return {None: "null", True: "true", False: "false"}[value if value is None else bool(value)]
    if isinstance(value, np.ndarray):
        return f"an array {list(value.shape)}"
    if isinstance(value, np.generic):
        return repr(value.item())
    if isinstance(value, (str, int, float)) or is_dataclass(value):
        return repr(value)
    return repr(str(value)) if isinstance(value, PurePath) else f"a value of type {type(value).__name__}"


@contextmanager
def under(prefix: str, error: type[UltragrayError] | None = None) -> Iterator[None]:
    """Errors from inside name their field as a part of `prefix`; InvalidArgument itself becomes `error`."""
    try:
        yield
    except UltragrayError as inner:
        raise error_under(prefix, inner, error) from inner


def error_under(prefix: str, inner: UltragrayError, error: type[UltragrayError] | None = None) -> UltragrayError:
    """The error of a part, as the whole sees it; InvalidArgument itself becomes `error`."""
    path = prefix if inner.field is None else join(prefix, inner.field)
    cls = error if error is not None and type(inner) is InvalidArgument else type(inner)
    detail = inner.detail
    if inner.field is None and detail.startswith("must "):
        detail = f"{path} {detail}"
    elif inner.field is not None and detail.startswith(inner.field):
        detail = join(prefix, detail)
    return cls(detail, field=path)


def join(prefix: str, path: str) -> str:
    """The path of a part: `probe` and `near_mm` make `probe.near_mm`, `poses` and `[3]` make `poses[3]`."""
    return f"{prefix}{path}" if path.startswith("[") or not prefix else f"{prefix}.{path}"

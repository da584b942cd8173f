"""Options of commands, made of the contract: `--min-confidence` of the field `min_confidence`, with its meaning.

    @app.command()
    @with_options
    def render(scene: Scene, settings: FrameSettings, sampler: Sampler | None) -> None:

A parameter whose type is a contract dataclass becomes an option for each of its fields, those of dataclasses within it
included. Of a sampler it becomes `--sampler KIND` and the fields of all kinds; other families are written as JSON, and
lists with commas; poses, tools and what is of a file are files. What is not given keeps its default.

    def train(settings: Annotated[dict[str, Any], FieldsOf(TrainingConfig)]) -> None:

takes only what was given, by the names of the fields.
"""

from __future__ import annotations

import inspect
import json
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field
from enum import Enum
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer

from ultragray.contract import Contract, Family, annotated_fields, from_dict, from_text, optional_of, range_of
from ultragray.errors import InvalidArgument
from ultragray.exchange.poses import load_poses
from ultragray.rendering.tools import Tool, load_tools
from ultragray.samplers import Sampler
from ultragray.scene.shapes import OfFile

FLAGS = {
    "settings": ("--set",),
    "pixel_mm": ("--pixel-mm", "--scan-convert"),
    "out_of_plane_mm": ("--out-of-plane",),
    "threads_per_process": ("--threads",),
    "training_threads": ("--threads",),
    "worker_labels": ("--require",),
}
_WITH_AN_OPTION_A_FIELD = (Sampler,)  # of all families
_PARSED = (bool, int, float, Path)
_FILES = ("poses", "tools")  # fields that are read from a file
_BETWEEN = "_between"  # ends the name of the field that an option fills in which is given as LOW:HIGH


class FieldsOf:
    """An annotation of a dict: it holds the fields of a contract dataclass that were given, of all or of some.

    `environment` begins the names of the environment variables that hold the fields as well.
    """

    def __init__(self, cls: type[Contract], *names: str, environment: str | None = None) -> None:
        self.cls, self.names = cls, names or tuple(item.name for item, _ in _fields(cls))
        self.environment = environment


def with_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Make a command of typer out of a function that takes contract dataclasses."""
    contracts: dict[str, Any] = {}
    own, parameters = parameters_in(command), list[inspect.Parameter]()
    for parameter in own:
        name, (cls, _) = parameter.name, optional_of(parameter.annotation)
        if isinstance(fields := getattr(cls, "__metadata__", (None,))[0], FieldsOf):
            contracts[name] = fields
            parameters += _chosen_parameters(fields)
        elif isinstance(cls, type) and issubclass(cls, Contract):
            contracts[name] = cls
            parameters += parameters_of(cls, name)
        else:
            parameters.append(parameter)

    @wraps(command)
    def run(**inputs: Any) -> Any:
        objects = {name: _object_of(cls, name, inputs) for name, cls in contracts.items()}
        return command(**{one.name: objects[one.name] if one.name in objects else inputs[one.name] for one in own})

    return with_parameters(run, parameters)


def _object_of(cls: Any, name: str, inputs: Mapping[str, Any]) -> Any:
    if isinstance(cls, FieldsOf):
        return values_of(cls.cls, defaultdict(lambda: None, inputs))
    return _part(cls, name, inputs) if issubclass(cls, Family) else cls(**values_of(cls, inputs))


def with_parameters(command: Callable[..., Any], parameters: list[inspect.Parameter]) -> Callable[..., Any]:
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return command


def parameters_in(function: Callable[..., Any]) -> list[inspect.Parameter]:
    hints = get_type_hints(function, include_extras=True)
    parameters = inspect.signature(function).parameters.items()
    return [one.replace(annotation=hints[name], kind=inspect.Parameter.KEYWORD_ONLY) for name, one in parameters]


def parameters_of(cls: Any, name: str = "") -> list[inspect.Parameter]:
    """The options of a contract dataclass or family, in panels of their topics; the first required is an argument."""
    if issubclass(cls, _WITH_AN_OPTION_A_FIELD):
        return [*_family_parameters(cls, name)]
    argument = next((item for item, _ in _fields(cls) if _is_required(item)), None)
    parameters: list[inspect.Parameter] = []
    for item, kind in _fields(cls):
        if _is_within(kind):
            parameters += parameters_of(kind, item.name)
        elif item is argument:
            parameters.insert(0, _parameter(item, kind, topic=None, is_argument=True))
        else:
            varies = " LOW:HIGH: drawn at random for each frame." if _may_vary(cls, item) else ""
            parameters.append(_parameter(item, str if varies else kind, topic=cls.__topic__, more=varies))
    return parameters


def _chosen_parameters(fields: FieldsOf) -> Iterator[inspect.Parameter]:
    for parameter in parameters_of(fields.cls):
        if parameter.name in fields.names:
            if fields.environment is not None:
                option = parameter.annotation.__metadata__[0]
                option.help += f" [{fields.environment}{parameter.name.upper()}]"
            yield parameter


def values_of(cls: Any, inputs: Mapping[str, Any]) -> dict[str, Any]:
    """The fields that options gave, as Python has them. Raises InvalidArgument, naming the option."""
    values = {}
    for item, kind in _fields(cls):
        if kind is bool:
            value = (not item.default) if inputs[item.name] else None
        elif _is_within(kind):
            value = _part(kind, item.name, inputs)
        elif _may_vary(cls, item) and ":" in (inputs[item.name] or ""):
            values[item.name + _BETWEEN] = from_text(inputs[item.name].replace(":", ","), tuple[float, ...])
            continue
        else:
            value = None if inputs[item.name] is None else _read(inputs[item.name], kind, item.name)
        if value is not None:
            values[item.name] = value
    return values


def _fields(cls: Any) -> Iterator[tuple[Field[Any], Any]]:
    for item, annotation in annotated_fields(cls):
        if item.name != "kind" and not item.name.endswith(_BETWEEN):
            yield item, optional_of(annotation)[0]


def _may_vary(cls: Any, item: Field[Any]) -> bool:
    return hasattr(cls, item.name + _BETWEEN)


def _is_within(kind: Any) -> bool:
    is_contract = isinstance(kind, type) and issubclass(kind, Contract) and not issubclass(kind, OfFile)
    return is_contract and (not issubclass(kind, Family) or kind in _WITH_AN_OPTION_A_FIELD)


def _family_parameters(family: Any, name: str) -> Iterator[inspect.Parameter]:
    help = f"One of {', '.join(family.members)}; each takes its own options only."
    option = typer.Option(_flag(name), help=help, show_default=False, rich_help_panel=family.__topic__)
    yield keyword(name, Annotated[str | None, option], None)
    members = {kind: {item.name: (item, of) for item, of in _fields(cls)} for kind, cls in family.members.items()}
    for option in dict.fromkeys(option for fields in members.values() for option in fields):
        takers = [kind for kind, fields in members.items() if option in fields]
        item, kind = members[takers[0]][option]
        yield _parameter(item, kind, topic=family.__topic__, takers=takers)


def _parameter(
    item: Field[Any],
    kind: Any,
    *,
    topic: str | None,
    is_argument: bool = False,
    takers: Sequence[str] = (),
    more: str = "",
) -> inspect.Parameter:
    """The option of a field, in the panel of its own topic, else of `topic`; `takers`: the kinds that take it."""
    meaning = str(item.metadata["description"])
    if takers:
        meaning = f"{', '.join(takers)}: {meaning[:1].lower()}{meaning[1:]}"
    if item.name == "poses":
        meaning = f"{meaning.rstrip('.')}: .npy or .json, [P, 4, 4] or [P, 3, 4], or .mcap."
    if item.name == "tools":
        meaning = f"{meaning} A .json file with a list of them: {', '.join(Tool.members)}, each with its numbers."
    limits = range_of(item).strip().removeprefix("of ")
    meaning += f" {limits[:1].upper()}{limits[1:]}." if limits else ""
    is_enum = isinstance(kind, type) and issubclass(kind, Enum)
    if choices := [one.value for one in kind] if is_enum else item.metadata.get("choices"):
        meaning += f" One of {', '.join(choices)}."
    meaning += more
    if isinstance(kind, type) and issubclass(kind, Family):
        presets = f" One of {', '.join(kind.named)}, or as" if kind.named else " As"
        meaning += f"{presets} JSON, a kind with its numbers: {'; '.join(map(_signature, kind.members.values()))}."
    is_switch, is_table = kind is bool, get_origin(kind) is dict
    is_file = item.name in _FILES or (isinstance(kind, type) and issubclass(kind, OfFile))
    parsed: Any = list[str] if is_table else Path if is_file else kind if kind in _PARSED else str
    flags = FLAGS.get(item.name, (_flag(f"no_{item.name}" if item.default is True else item.name),))
    show_default = not is_switch and _shown_default(item)
    option = typer.Option(
        *flags,
        help=meaning,
        metavar="NAME=VALUE" if is_table else None,
        show_default=show_default,
        rich_help_panel=item.metadata.get("topic", topic),
    )
    if is_switch:
        return keyword(item.name, Annotated[bool, option], False)
    if is_argument:
        return keyword(item.name, Annotated[parsed, typer.Argument(help=meaning, show_default=False)])
    if _is_required(item) and not takers:
        return keyword(item.name, Annotated[parsed, option])
    return keyword(item.name, Annotated[parsed | None, option], None)


def poses_option(*, default: str) -> Any:
    """`--poses FILE`; `default`: the words for the poses that are taken without it."""
    return typer.Option(
        help="Poses: .npy or .json, [P, 4, 4] or [P, 3, 4], in mm, or .mcap of ROS 2.",
        show_default=default,
        rich_help_panel=Sampler.__topic__,
    )


def _signature(member: Any) -> str:
    return "{" + ", ".join([f'"kind": "{member.kind}"', *(f'"{item.name}": …' for item, _ in _fields(member))]) + "}"


def keyword(name: str, annotation: Any, default: Any = inspect.Parameter.empty) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _is_required(item: Field[Any]) -> bool:
    return item.default is MISSING and item.default_factory is MISSING


def _shown_default(item: Field[Any]) -> str | bool:
    """The default as it would be typed; False where the meaning tells what is taken."""
    default = item.default.value if isinstance(item.default, Enum) else item.default
    if isinstance(default, tuple):
        default = ",".join(map(str, default))
    return False if default in (None, MISSING, "") else str(default)


def _part(cls: Any, name: str, inputs: Mapping[str, Any]) -> Any:
    """The object that the options of a part or of a sampler give; None where none of them was given."""
    if not issubclass(cls, Family):
        values = values_of(cls, inputs)
        return cls(**values) if values else None
    options = dict.fromkeys(item.name for member in cls.members.values() for item, _ in _fields(member))
    document = {option: inputs[option] for option in options if inputs[option] is not None}
    if inputs[name] is not None:
        if (member := cls.members.get(inputs[name])) is None:
            raise InvalidArgument(
                f"{_flag(name)} must be one of {', '.join(cls.members)}, got {inputs[name]!r}", field=name
            )
        fields = {item.name: item for item, _ in _fields(member)}
        for option, item in fields.items():
            if _is_required(item) and option not in document:
                raise InvalidArgument(f"{_flag(name)} {inputs[name]} needs {_flag(option)}", field=option)
        for option in document:
            if option not in fields:
                raise InvalidArgument(f"{_flag(name)} {inputs[name]} takes no {_flag(option)}", field=option)
        return from_dict(cls, {"kind": inputs[name], **document})
    for option in document:
        raise InvalidArgument(f"{_flag(option)} is of a {name}: name it with {_flag(name)}", field=option)
    return None


def _read(value: Any, kind: Any, name: str) -> Any:
    if name in _FILES:
        return load_poses(value) if name == "poses" else load_tools(value)
    if isinstance(kind, type) and issubclass(kind, OfFile):
        return kind(**kind.of_file(value))
    if get_origin(kind) is tuple:
        return from_text(value, kind)
    if get_origin(kind) is dict:
        return pairs_of(value, FLAGS[name][0]) if get_args(kind)[1] is str else parse_settings(value)
    if isinstance(kind, type) and issubclass(kind, Family):
        return kind.named[value] if value in kind.named else from_dict(kind, _parsed_json(value, kind, name))
    return from_text(value, kind) if isinstance(value, str) else value


def _parsed_json(text: str, family: type[Family], name: str) -> Any:
    try:
        return json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        names = "".join(f"{one}, " for one in family.named)
        what = f"one of {names}or a JSON object" if names else "a JSON object"
        raise InvalidArgument(f"{_flag(name)} must be {what}: {error}", field=name) from error


def parse_settings(settings: list[str]) -> dict[str, Any]:
    """NAME=VALUE pairs, the value as in TOML; a bare word is itself."""
    from ultragray.learn.training.config import parse_value

    return {name: parse_value(value) for name, value in pairs_of(settings, "--set").items()}


def pairs_of(texts: list[str], flag: str) -> dict[str, str]:
    pairs = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise InvalidArgument(f"{flag} takes NAME=VALUE, got {text!r}", field=flag.removeprefix("--"))
        pairs[name.strip()] = value.strip()
    return pairs


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"

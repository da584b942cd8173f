"""Generates what the client does not write by hand: `python client/generate.py`.

`contract.py` are the service's dataclasses that callers fill in or get, without its checks, and `errors.py` the errors
that calls may end with, so that the client needs neither `ultragray` nor torch.
"""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterable, Iterator
from dataclasses import MISSING, Field, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, get_args, get_type_hints

from ultragray.contract import Contract, Family, annotated_fields
from ultragray.datasets.source import SourceOptions
from ultragray.errors import error_classes
from ultragray.exchange import ros_messages, ros_recording
from ultragray.geometry import pose
from ultragray.geometry.motion import MAX_AHEAD_MS, Prediction
from ultragray.geometry.probe import ElevationBeam
from ultragray.learn.planning.settings import PlanSettings
from ultragray.rendering.preview import Preview
from ultragray.rendering.settings import RenderSettings, SettingsUsed
from ultragray.rendering.volumes import SliceSettings
from ultragray.scene.confidence import Extrapolation
from ultragray.scene.edits import Edit
from ultragray.scene.recipes import SceneRecipe
from ultragray_service.core.clocks import ClockOffset
from ultragray_service.core.recordings import RecordingView
from ultragray_service.errors import STATUSES
from ultragray_workers.datasets.recording import RecordingSettings
from ultragray_workers.datasets.store import DatasetRecord
from ultragray_workers.jobs.kinds import Specification

PACKAGE = Path(__file__).resolve().parent / "ultragray_client"

# The classes that callers fill in or get, each with all that it is made of, and the names that the client gives them.
ROOTS = {
    "RenderSettings": RenderSettings,
    "SettingsUsed": SettingsUsed,
    "Extrapolation": Extrapolation,
    "Prediction": Prediction,
    "ClockOffset": ClockOffset,
    "Preview": Preview,
    "SliceSettings": SliceSettings,
    "PlanSettings": PlanSettings,
    "ElevationBeam": ElevationBeam,
    "DatasetOptions": SourceOptions,
    "Dataset": DatasetRecord,
    "RecordingSettings": RecordingSettings,
    "RecordingView": RecordingView,
    "Specification": Specification,
    "Edit": Edit,
    "SceneRecipe": SceneRecipe,
}
LEFT_OUT = {"device_set", "calibration"}  # files are uploaded with their dataset
OWN_TYPES = {"Poses": "Iterable[PoseLike]"}  # what the client takes in their place

NOT_OVER_GRPC = {  # reasons of other doors, and of jobs that failed
    "ORIGIN_REFUSED",
    "BODY_TOO_LARGE",
    "NOT_ACCEPTABLE",
    "UNSUPPORTED_MEDIA_TYPE",
    "ROUTE_NOT_FOUND",
    "METHOD_NOT_ALLOWED",
    "SCENE_READ_ONLY",
    "STREAM_NOT_FOUND",
    "IGTL_MESSAGE_INVALID",
    "CHECKPOINT_INVALID",
    "TRAINING_DIVERGED",
    "TRAINING_STATE_INVALID",
    "STARTUP_FAILED",
}
OWN_ERRORS = {  # of the client, by their reason: base, meaning
    "UNREACHABLE": ("Unavailable", "Nobody answers at the address, or the connection broke."),
    "TLS_FAILED": ("ClientError", "The service shows no certificate to trust, or does not speak TLS."),
    "STREAM_ENDED": ("ClientError", "A stream of poses that is over was asked to go on."),
}
COPIES = {  # modules that the client has as they are, by its names
    "poses": pose,
    "recording/messages": ros_messages,
    "recording/writer": ros_recording,
}
OWN_IMPORTS = {  # what they import, as the client has it
    "from ultragray.errors import": "from ultragray_client.errors import",
    "from ultragray.geometry.probe import FloatArray\n": "from ultragray_client.geometry import FloatArray\n",
    "from ultragray.geometry.pose import": "from ultragray_client.poses import",
    "from ultragray.exchange import ros_messages as ros\n": "from ultragray_client.recording import messages as ros\n",
}
_ALSO = {"InvalidArgument": ["ValueError"], "DeadlineExceeded": ["TimeoutError"]}  # what they are beside

_ERRORS_HEADER = '''# Generated from the errors of the service by client/generate.py; change those.
"""Every error of the client, in one tree. Programs match the class, or `reason`, which never changes.

{tree}

A reason that this client does not know is told with the class of its gRPC status, or ClientError.
"""

from __future__ import annotations

from .client_error import ClientError as ClientError

'''
_CONTRACT_HEADER = '''# Generated from the dataclasses of ultragray by client/generate.py; change those.
"""The dataclasses that callers fill in, or get. The service checks the values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from dataclasses import field as field_of
from enum import Enum
from types import MappingProxyType
from typing import Any, Literal, TypeAlias

from .geometry import Picture, PoseLike
'''
_COPY_HEADER = "# Generated from {module} by client/generate.py; change that.\n"
_RAISES = re.compile(r"\s*\bRaises\s.*?(?=\n\n|\Z)", flags=re.DOTALL)


def generate_errors(output_folder: Path) -> Path:
    """Writes errors.py and returns its path."""
    classes = dict(_error_classes())
    tree = _below("ClientError", {name: bases[0] for name, (bases, _) in classes.items()})
    lines = "\n".join(["ClientError", *(line for line, _ in tree)])
    sources = [
        f"class {name}({', '.join(classes[name][0])}):\n    {_quoted(_wrapped(classes[name][1]))}\n" for _, name in tree
    ]
    target = output_folder / "errors.py"
    target.write_text(_ERRORS_HEADER.format(tree=lines) + "\n".join([*sources, "ERRORS = ClientError.branch()\n"]))
    return formatted([target])[0]


def _error_classes() -> Iterator[tuple[str, tuple[list[str], str]]]:
    """Name, bases and meaning of each class: below that of its gRPC status, which stands for all its reasons."""
    meanings = {
        cls.reason: " ".join(inspect.cleandoc(cls.__doc__ or "").split("\n\n")[0].split()) for cls in error_classes()
    }
    classes = {}
    for reason, statuses in STATUSES.items():
        status = statuses.grpc
        if reason not in {*NOT_OVER_GRPC, "INTERNAL"}:
            base = "ClientError" if status == "INTERNAL" else _camel(status)
            root = meanings.get(status, f"Base of the errors whose gRPC status is {status}.")
            classes.setdefault(base, ("ClientError", root))
            classes.setdefault(_camel(reason), (base, meanings[reason]))
    classes.pop("ClientError", None)
    classes |= {_camel(reason): base_and_meaning for reason, base_and_meaning in OWN_ERRORS.items()}
    return ((name, ([base, *_ALSO.get(name, ())], meaning)) for name, (base, meaning) in classes.items())


def _camel(reason: str) -> str:
    return reason.title().replace("_", "")


def _below(base: str, bases: dict[str, str], indent: str = "") -> list[tuple[str, str]]:
    """The classes below a base, in their order, each with its line of the drawn tree."""
    below = [name for name, own in bases.items() if own == base]
    lines = []
    for name in below:
        branch, further = ("└── ", "    ") if name == below[-1] else ("├── ", "│   ")
        lines += [(f"{indent}{branch}{name}", name), *_below(name, bases, indent + further)]
    return lines


def generate_contract(output_folder: Path) -> Path:
    """Writes contract.py and returns its path."""
    sources = {"MAX_AHEAD_MS": f"MAX_AHEAD_MS = {MAX_AHEAD_MS}  # that the service foretells a pose\n"}
    for name, cls in ROOTS.items():
        _add(sources, cls, name)
    names = sorted(sources, key=lambda name: (not name.isupper(), name))  # constants first
    target = output_folder / "contract.py"
    target.write_text("\n".join([_CONTRACT_HEADER, f"__all__ = {names!r}", *sources.values()]))
    return formatted([target])[0]


def generate_copies(output_folder: Path) -> list[Path]:
    """Writes the modules that the client has as they are, and returns their paths."""
    written = []
    for name, module in COPIES.items():
        text = _COPY_HEADER.format(module=module.__name__) + inspect.getsource(module)
        for theirs, own in OWN_IMPORTS.items():
            text = text.replace(theirs, own)
        target = output_folder / f"{name}.py"
        target.parent.mkdir(exist_ok=True)
        target.write_text(text)
        written.append(target)
    return formatted(written)


def _add(sources: dict[str, str], cls: Any, name: str) -> None:
    """Adds the source of a class under its name, after those of all that it is made of."""
    if name in sources:
        return
    if issubclass(cls, Enum):
        sources[name] = _enum_source(cls)
    elif Family in cls.__bases__:
        for member in cls.members.values():
            _add(sources, member, member.__name__)
        sources[name] = f"{name}: TypeAlias = {' | '.join(member.__name__ for member in cls.members.values())}"
        if cls.named:
            entries = ", ".join(f"{called!r}: {member!r}" for called, member in cls.named.items())
            sources[f"{name.upper()}S"] = f"{name.upper()}S: Mapping[str, {name}] = MappingProxyType({{{entries}}})"
    else:
        bases = [base for base in cls.__bases__ if is_dataclass(base) and Family not in base.__bases__]
        for other in (*bases, *_classes_in(get_type_hints(cls).values())):
            _add(sources, other, other.__name__)
        sources[name] = _dataclass_source(cls, name, bases)


def _classes_in(annotations: Iterable[Any]) -> Iterator[Any]:
    for annotation in annotations:
        if isinstance(annotation, type) and issubclass(annotation, (Contract, Enum)):
            yield annotation
        yield from _classes_in(get_args(annotation))


def _enum_source(cls: type[Enum]) -> str:
    members = "\n".join(f"    {member.name} = {member.value!r}" for member in cls)
    return f"class {cls.__name__}(str, Enum):\n    {_docstring(cls)}\n\n{members}\n"


def _dataclass_source(cls: Any, name: str, bases: list[Any]) -> str:
    families = [base for base in cls.__bases__ if Family in base.__bases__]  # their members have their fields
    names = {name for one in (cls, *families) for name in inspect.get_annotations(one)} - LEFT_OUT
    items = [item for item, _ in annotated_fields(cls) if item.name in names and item.metadata]  # not a base's `kind`
    own = sorted(items, key=lambda item: item.kw_only)
    is_kw_only = all(item.kw_only for item in own)
    options = "frozen=True, kw_only=True" if is_kw_only else "frozen=True"
    head = f"class {name}" + (f"({', '.join(base.__name__ for base in bases)})" if bases else "")
    body = "\n".join(_field_source(item, kw_only=item.kw_only and not is_kw_only) for item in own)
    return f"@dataclass({options})\n{head}:\n    {_docstring(cls)}\n\n{body}\n"


def _field_source(item: Field[Any], *, kw_only: bool) -> str:
    if str(item.type).startswith("Literal"):  # what tells a member of a family apart
        return f"    kind: Literal[{item.default!r}] = field_of(default={item.default!r}, repr=False, kw_only=True)"
    arguments = ""
    if item.default is not MISSING:
        arguments = f"default={_default_source(item.default)}"
    elif item.default_factory is not MISSING:
        arguments = f"default_factory={item.default_factory.__name__}"
    default = f" = field_of({arguments}{', kw_only=True' if kw_only else ''})" if arguments else ""
    if arguments.startswith("default=") and not kw_only:
        default = f" = {arguments.removeprefix('default=')}"
    annotation = re.sub(r"\w+", lambda word: OWN_TYPES.get(word[0], word[0]), str(item.type))
    source, words = f"    {item.name}: {annotation}{default}", item.metadata["description"]
    if len(line := f"{source}  # {words}") <= 120:
        return line
    return "\n".join([*(f"    # {part}" for part in textwrap.wrap(words, 110)), source])


def _default_source(default: Any) -> str:
    if isinstance(default, Contract):  # a class whose own defaults it has
        return f"{type(default).__name__}()"
    return str(default) if isinstance(default, Enum) else repr(default)


def _docstring(cls: Any) -> str:
    """The docstring, but for the errors: the client leaves checks to the service."""
    return _quoted(_RAISES.sub("", inspect.cleandoc(cls.__doc__)).strip().replace("\n", "\n    "))


def _wrapped(text: str) -> str:
    return "\n    ".join(textwrap.wrap(text, 110))


def _quoted(text: str) -> str:
    return f'"""{text}' + ('\n    """' if "\n" in text else '"""')


def formatted(paths: list[Path]) -> list[Path]:
    """The files, in the project's format, from its root: there its configuration knows which packages are its own."""
    root = PACKAGE.parents[1]
    configuration = ["--config", str(root / "pyproject.toml"), "--quiet", *(str(path.resolve()) for path in paths)]
    for command in (["check", "--select=I", "--fix"], ["format"]):
        subprocess.run([sys.executable, "-m", "ruff", *command, *configuration], check=True, cwd=root)
    return paths


if __name__ == "__main__":
    generate_errors(PACKAGE)
    generate_contract(PACKAGE)
    generate_copies(PACKAGE)

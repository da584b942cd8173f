"""The parts that commands share: panels of options, --json and --force, examples in a help."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

OUTPUT, COMPUTE = "Output", "Compute"

Json = Annotated[
    bool, typer.Option("--json", help="One JSON document on standard output, for scripts.", rich_help_panel=OUTPUT)
]
Force = Annotated[bool, typer.Option("--force", help="Replace what is there.", rich_help_panel=OUTPUT)]
Threads = Annotated[int, typer.Option(min=0, help="Threads; 0: all cores.", rich_help_panel=COMPUTE)]
Backend = Annotated[str, typer.Option(help="auto, cpu, cuda or reference.", rich_help_panel=COMPUTE)]
SceneFile = Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file (.ugr).", show_default=False)]


def command_group(help: str | None = None) -> typer.Typer:
    """A typer app for one command, or for a group of commands."""
    return typer.Typer(
        add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode="rich", help=help
    )


def examples(*lines: str) -> str:
    """The epilogue of a help: each line is a command that a shell takes as it stands, or a # comment."""
    return "\n\n".join(("[bold]Examples[/bold]", *(line.replace("[", r"\[") for line in lines)))


def output_option(help: str, *, default: str | None = None) -> Any:
    """`--output FILE`, `-o FILE`; `default`: the words for what happens without it."""
    shown: Any = False if default is None else default
    return typer.Option("--output", "-o", help=help, show_default=shown, rich_help_panel=OUTPUT)


def tell(sentence: str, document: Any, *, as_json: bool) -> None:
    """Print what a command did, as one sentence for a person or as a JSON document for a program."""
    typer.echo(to_json(document) if as_json else sentence)


def to_json(document: Any) -> str:
    """A JSON document as commands print it: paths and the like as text, numbers that JSON does not have as null."""
    return json.dumps(_finite(document), indent=2, ensure_ascii=False, allow_nan=False, default=str)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def frames_in_words(count: int) -> str:
    """Such as `1 frame` or `1,200 frames`."""
    return f"{count:,} frame{'' if count == 1 else 's'}"


def warn(text: str) -> None:
    """A warning on stderr."""
    typer.secho(f"warning: {text}", fg=typer.colors.YELLOW, err=True)

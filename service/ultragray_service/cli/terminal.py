"""What commands share: options such as --json, where they may write, what they print, progress, and stopping."""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ultragray.errors import InvalidArgument
from ultragray_workers.scene_names import SUFFIXES

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress


OUTPUT, COMPUTE = "Output", "Compute"
Columns = Mapping[str, Callable[[Any], str]]

Json = Annotated[
    bool, typer.Option("--json", help="One JSON document on standard output, for scripts.", rich_help_panel=OUTPUT)
]
Force = Annotated[bool, typer.Option("--force", help="Replace what is there.", rich_help_panel=OUTPUT)]
Threads = Annotated[int, typer.Option(min=0, help="Threads; 0: all cores.", rich_help_panel=COMPUTE)]
Backend = Annotated[str, typer.Option(help="auto, cpu, cuda or reference.", rich_help_panel=COMPUTE)]
SceneFile = Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file (.ugr or .ugz).", show_default=False)]


def command_group(help: str | None = None) -> typer.Typer:
    return typer.Typer(
        add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode="rich", help=help
    )


def single(*lines: str, name: str | None = None) -> Callable[[Callable[..., Any]], typer.Typer]:
    """A decorator that makes an app of one command, with these examples, of a function."""

    def app_of(command: Callable[..., Any]) -> typer.Typer:
        app = command_group()
        app.command(name, epilog=examples(*lines))(command)
        return app

    return app_of


def examples(*lines: str) -> str:
    return "\n\n".join(("[bold]Examples[/bold]", *(line.replace("[", r"\[") for line in lines)))


def option(help: str, *flags: str, shown: str | bool = True, panel: str | None = None, **others: Any) -> Any:
    """An option of a command, in a panel of its help; `shown`: the words for its default, False for none."""
    return typer.Option(*flags, help=help, show_default=shown, rich_help_panel=panel, **others)


def argument(help: str, **others: Any) -> Any:
    return typer.Argument(help=help, show_default=False, **others)


def output_option(help: str, *, default: str | None = None) -> Any:
    """`--output FILE`, `-o FILE`; `default`: the words for what happens without it."""
    show_default: Any = False if default is None else default
    return typer.Option("--output", "-o", help=help, show_default=show_default, rich_help_panel=OUTPUT)


def tell(sentence: str, document: Any, *, as_json: bool) -> None:
    typer.echo(to_json(document) if as_json else sentence)


def tell_facts(document: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        typer.echo(to_json(document))
    else:
        print_facts(document)


def tell_table(columns: Columns, documents: Sequence[Any], *, as_json: bool) -> None:
    """A row for each document under the columns, each of which says what it holds of one; or the documents."""
    if as_json:
        typer.echo(to_json(documents))
    else:
        print_table([*columns], [[cell(one) for cell in columns.values()] for one in documents])


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
    return f"{count:,} frame{'' if count == 1 else 's'}"


def minutes_and_seconds(seconds: float) -> str:
    return "{}:{:02d}".format(*divmod(round(seconds), 60))


def warn(text: str) -> None:
    typer.secho(f"warning: {text}", fg=typer.colors.YELLOW, err=True)


SCENE_SUFFIX, COMPRESSED_SUFFIX = SUFFIXES
_REPORT_EVERY_S = 10.0
_PIPE_COLUMNS = 400  # where no terminal says how wide it is, nothing is cut
OR_A_FOLDER = ", or be a folder for PNGs (a name without an ending)"
_PICTURES = (".png", ".jpg", ".jpeg")
_SIMILAR = {".hdf5": ".h5", ".hdf": ".h5", ".mha": ".igs.mha", ".zarr": ".zarr.zip", ".dicom": ".dcm", ".jpeg": ".jpg"}


def check_file(path: Path, suffixes: Sequence[str] = (), *, force: bool) -> None:
    """Raise InvalidArgument where a file cannot be written to `path`, or may not.

    That is: the name ends in none of `suffixes` (none given: any will do), `path` is a folder or exists without
    `force`, or its folder is not there or cannot be written to.
    """
    if path.is_dir():
        raise InvalidArgument(f"output must be a file, {path} is a folder", field="output")
    check_ending(path, suffixes)
    folder = path.absolute().parent
    if not folder.is_dir():
        raise InvalidArgument(f"output must lie in a folder that exists, {path.parent} does not", field="output")
    if not os.access(folder, os.W_OK):
        raise InvalidArgument(f"output must lie in a folder that can be written to, {folder} cannot", field="output")
    if path.exists() and not force:
        raise InvalidArgument(f"{path} exists: --force replaces it", field="output")


def check_folder(path: Path, *, force: bool) -> None:
    """Raise InvalidArgument where `path` is a file, cannot be written to, or without `force` holds something."""
    if path.exists() and not path.is_dir():
        raise InvalidArgument(f"output must be a folder, {path} is a file", field="output")
    existing = next(one for one in (path.absolute(), *path.absolute().parents) if one.exists())
    if not os.access(existing, os.W_OK):
        raise InvalidArgument(f"output must be a folder that can be written to, {existing} cannot", field="output")
    if path.is_dir() and not force and next(path.iterdir(), None) is not None:
        raise InvalidArgument(
            f"output must be a new or empty folder, {path} holds files: --force writes among them", field="output"
        )


def check_ending(path: Path, suffixes: Sequence[str], *, otherwise: str = "") -> None:
    """Raise InvalidArgument where a name ends in none of `suffixes`; `otherwise`: what else it may be, in words."""
    if suffixes and not path.name.endswith(tuple(suffixes)):
        suffix = path.suffix.lower()
        similar = _SIMILAR.get(suffix)
        near = [similar] if similar in suffixes else get_close_matches(suffix, suffixes, n=1, cutoff=0.7)
        perhaps = f"; did you mean {near[0]}?" if near and len(suffixes) > 1 and suffix not in _PICTURES else ""
        *others, last = suffixes
        expected = f"{', '.join(others)} or {last}" if others else last
        raise InvalidArgument(f"output must end in {expected}{otherwise}, got {path.name!r}{perhaps}", field="output")


def is_folder_name(path: Path) -> bool:
    return path.is_dir() or not path.suffix


def print_facts(document: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    facts = {key: _text(value) for key, value in document.items() if value not in (None, {}, [])}
    console = Console()
    if not console.is_terminal:  # no padding for other programs, and nothing is cut
        width = max(map(len, facts), default=0)
        typer.echo("\n".join(f"{key:<{width}}  {text}" for key, text in facts.items()))
        return
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for key, text in facts.items():
        table.add_row(key, escape(text))  # a scene's own strings must not be read as markup
    console.print(table)


def _text(value: Any) -> str:
    if isinstance(value, dict):
        return "  ".join(f"{key}={_text(item)}" for key, item in value.items())
    if isinstance(value, (list, tuple)):
        return "(" + ", ".join(_text(item) for item in value) + ")"
    if isinstance(value, float):
        return f"{value:.6g}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)


def print_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table(*columns, box=None, pad_edge=False)
    table.columns[0].no_wrap = True
    for row in rows:
        table.add_row(*map(escape, row))  # a reason or a name may hold brackets
    wide_console().print(table)


def wide_console() -> Console:
    """Standard output; what is not a terminal is so wide that nothing is cut."""
    from rich.console import Console

    console = Console()
    if not console.is_terminal:
        console.width = _PIPE_COLUMNS
    return console


@contextlib.contextmanager
def progress_bars(*columns: str) -> Iterator[Progress]:
    """Bars on standard error, between texts such as "{task.description}"; disabled elsewhere than on a terminal.

    A column may be named as well: "bar", "of" (how many of how many), "bytes", "rate" of these, "left" (time).
    """
    from rich import progress as rich_progress
    from rich.console import Console

    kinds = {
        "bar": rich_progress.BarColumn,
        "of": rich_progress.MofNCompleteColumn,
        "bytes": rich_progress.DownloadColumn,
        "rate": rich_progress.TransferSpeedColumn,
        "left": rich_progress.TimeRemainingColumn,
    }
    console = Console(stderr=True)
    bar_columns = (kinds[one]() if one in kinds else rich_progress.TextColumn(one, markup=False) for one in columns)
    with rich_progress.Progress(*bar_columns, console=console, transient=True, disable=not console.is_terminal) as bars:
        yield bars


@contextlib.contextmanager
def counted(what: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """A function that is told how many of `total` (None: unknown) are done: a bar on a terminal, elsewhere a line every
    10 s.
    """
    started = last_report = time.monotonic()

    def tell_done(done: int) -> None:
        nonlocal last_report
        bars.update(task, completed=done)
        now = time.monotonic()
        if bars.disable and done and now - last_report >= _REPORT_EVERY_S:
            last_report = now
            minutes = 0.0 if total is None else (now - started) * (total - done) / done / 60.0
            of_all = "" if total is None else f" of {total:,}, {minutes:.1f} min left"
            typer.echo(f"{what}: {done:,}{of_all}", err=True)

    with progress_bars("{task.description}", "bar", "of", "left") as bars:
        task = bars.add_task(what, total=total)
        yield tell_done


@contextlib.contextmanager
def transferred(what: str) -> Iterator[Callable[[int | None], Callable[[int], None]]]:
    """A function that begins a transfer of so many bytes (None: unknown), and returns what is told of each block."""
    with progress_bars("{task.description}", "bar", "bytes", "rate", "left") as bars:

        def begin(total: int | None) -> Callable[[int], None]:
            task = bars.add_task(what, total=total)
            return lambda count: bars.advance(task, count)

        yield begin


@contextlib.contextmanager
def working(what: str) -> Iterator[None]:
    """A line that moves while something of unknown length is done: on a terminal only."""
    from rich.console import Console
    from rich.markup import escape

    console = Console(stderr=True)
    if console.is_terminal:
        with console.status(escape(what)):
            yield
    else:
        yield


@contextlib.contextmanager
def interrupted_by_sigterm() -> Iterator[None]:
    """SIGTERM ends what is done as Ctrl-C does: half-written files are removed. For the main thread alone."""

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        if signal.getsignal(signal.SIGTERM) is interrupt:  # else the process is stopping, and ignores it to its end
            signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def stop_on_signal() -> Iterator[Callable[[], bool]]:
    """A function that tells whether SIGINT or SIGTERM came; a process that is stopping ignores more of them."""
    signals: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda came, frame: signals.append(came)) for number in numbers]
    try:
        yield lambda: bool(signals)
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, signal.SIG_IGN if signals else handler)

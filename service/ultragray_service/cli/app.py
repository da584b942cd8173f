"""The command line `ultragray`: a table of commands, each imported when it is used; mistakes are told in one line."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from ultragray_service.cli.terminal import examples, option

USER_ERROR = 2  # the exit code of a mistake that the caller can mend
INTERRUPTED = 130  # the exit code of a command that Ctrl-C or SIGTERM stopped


@dataclass(frozen=True)
class Entry:
    name: str
    app: str  # "module:name" of the typer app of the command, or of the group of commands; .module: of this package
    panel: str
    summary: str  # the first line of its help

    def load(self) -> Any:
        module, _, name = self.app.partition(":")
        command = typer.main.get_command(getattr(import_module(module, __package__), name))
        command.name = self.name
        command.help = "\n\n".join(filter(None, (self.summary, command.help)))
        command.rich_help_panel = self.panel  # type: ignore[attr-defined]
        return command

    def described(self) -> TyperCommand:
        """A command that has a name and a line of help, for lists, and cannot be run."""
        return TyperCommand(self.name, help=self.summary, rich_help_panel=self.panel)


class _Loaded(Mapping[str, Any]):
    def __init__(self, group: LazyGroup) -> None:
        self._group = group

    def __getitem__(self, name: str) -> Any:
        if (entry := self._group.entry(name)) is None:
            raise KeyError(name)
        return entry.load()

    def __iter__(self) -> Iterator[str]:
        return iter(self._group.list_commands(None))

    def __len__(self) -> int:
        return len(self._group.list_commands(None))


def _entries_of(point: EntryPoint) -> tuple[Entry, ...]:
    """The entries of another package; none, and a warning, where it cannot be imported."""
    try:
        return tuple(point.load())
    except ImportError as error:
        typer.secho(f"warning: the commands of {point.value} are left out: {error}", fg=typer.colors.YELLOW, err=True)
        return ()


class LazyGroup(TyperGroup):
    """A group whose commands are loaded when they run; lists of them need only the entries.

    Mistakes end the process with one line on stderr, `error: …`, and exit code 2. So do the errors of the project and
    of the file system.
    """

    entries: tuple[Entry, ...] = ()
    plugins: str | None = None  # group of the entry points of other packages, each a tuple of entries

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands = _Loaded(self)  # type: ignore[assignment]  # nobody adds to it

    @cached_property
    def _own(self) -> dict[str, Entry]:
        return {entry.name: entry for entry in self.entries}

    @cached_property
    def _all(self) -> dict[str, Entry]:
        """The own entries, and those of other packages; to find these takes some hundredths of a second."""
        found = [] if self.plugins is None else entry_points(group=self.plugins)
        return {**{entry.name: entry for point in found for entry in _entries_of(point)}, **self._own}

    def entry(self, name: str) -> Entry | None:
        return self._own.get(name) or self._all.get(name)

    def list_commands(self, ctx: Any) -> list[str]:
        return [*self._own, *(name for name in self._all if name not in self._own)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """A command as lists show it; what runs comes from `resolve_command`."""
        entry = self.entry(cmd_name)
        return None if entry is None else entry.described()

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name, found, rest = super().resolve_command(ctx, args)
        entry = self.entry(name or "")
        return name, found if entry is None else entry.load(), rest

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        windows_expand_args: bool = True,
        **extra: Any,
    ) -> Any:
        prog_name = prog_name or "ultragray"  # also by `python -m` and the like
        if not standalone_mode:
            return super().main(args, prog_name, complete_var, False, windows_expand_args, **extra)
        try:
            code = super().main(args, prog_name, complete_var, False, windows_expand_args, **extra)
        except typer.TyperException as error:
            if type(error).__name__ != "NoArgsIsHelpError":  # the help has been printed
                _say_error(_in_one_line(error))
            raise SystemExit(USER_ERROR) from None
        except typer.Abort:
            raise SystemExit(INTERRUPTED) from None
        raise SystemExit(code if isinstance(code, int) else 0)

    def invoke(self, ctx: Any) -> Any:
        from ultragray.errors import UltragrayError
        from ultragray.installation import missing_extra

        try:
            return super().invoke(ctx)
        except BrokenPipeError:  # `ultragray show scene.ugr | head`: nobody is left to tell
            raise
        except UltragrayError as error:
            message = error.detail
        except ModuleNotFoundError as error:
            message = missing_extra(error, "this command").detail
        except OSError as error:
            message = f"{error.filename}: {error.strerror}" if error.filename and error.strerror else str(error)
        _say_error(message)
        raise typer.Exit(USER_ERROR)


def _say_error(message: str) -> None:
    typer.secho(f"error: {message}", fg=typer.colors.RED, err=True)


def _in_one_line(error: typer.TyperException) -> str:
    context = getattr(error, "ctx", None)
    option = getattr(error, "option_name", None)
    if option is not None and type(error).__name__ == "NoSuchOption":
        sentence = f"no such option: {option}{_perhaps(option, _options_of(context))}"
    else:
        sentence = _about_value(error) or " ".join(error.format_message().split()).rstrip(".")
        sentence = sentence[:1].lower() + sentence[1:]
    return sentence if context is None else f"{sentence} (see `{context.command_path} --help`)"


def _about_value(error: typer.TyperException) -> str | None:
    """The sentence for a value that an option cannot take, with the value; None for other mistakes."""
    parameter, reasons = getattr(error, "param", None), getattr(error.__cause__, "errors", None)
    if parameter is None or reasons is None:  # of pydantic's ValidationError, which typer reads values with
        return None
    reason = reasons()[0]
    message, _, choices = str(reason["msg"]).partition(" is not one of ")
    if choices:
        expected = f"must be one of {choices.rstrip('.')}".replace("'", "")
    else:
        expected = message.partition(",")[0].replace("Input should be", "must be")
    name = parameter.opts[0] if parameter.param_type_name == "option" else parameter.display_name_raw.upper()
    return f"{name} {expected}, got {reason['input']!r}" if "must be" in expected else None


def _options_of(context: Any) -> list[str]:
    if context is None:
        return []
    return [name for parameter in context.command.get_params(context) for name in parameter.opts if name[:2] == "--"]


def _perhaps(word: str, known: list[str]) -> str:
    found = get_close_matches(word, known, n=2)
    return f"; did you mean {' or '.join(found)}?" if found else ""


_SERVING, _SCENES, _SWEEPS = "Serve", "Scenes and frames", "Sweeps and training"
_REMOTE, _INSTALLATION = "A running service (--address)", "An installation's folders"


class _Commands(LazyGroup):
    plugins = "ultragray.commands"
    entries = (
        Entry("serve", ".serve:serve", _SERVING, "Serve scenes over HTTP and gRPC, until Ctrl-C or SIGTERM."),
        Entry("worker", ".worker:worker", _SERVING, "Take jobs from the queue, one at a time, until Ctrl-C."),
        Entry("demo", ".scenes:demo", _SCENES, "Write the built-in demo scene."),
        Entry("show", ".scenes:show", _SCENES, "Print what a scene file or a sweep says about itself."),
        Entry("render", ".render:render", _SCENES, "Render frames from poses into one file or a folder of PNGs."),
        Entry("export", ".scenes:export", _SCENES, "Write a scene as PLY or as a checkpoint of the released code."),
        Entry("localize", ".register:localize", _SCENES, "Find the pose of a real frame in a scene."),
        Entry("calibrate", ".register:calibrate_app", _SCENES, "Register a robot or tracker to a scene."),
        Entry("voxelize", ".scenes:voxelize", _SCENES, "Sample a scene on a grid: a NIfTI or NRRD volume, or a slice."),
        Entry("slicer", ".scenes:slicer", _SCENES, "Write a scene file of 3D Slicer that shows a served scene live."),
        Entry("import", ".scenes:import_scene", _SCENES, "Turn a PLY file or a released checkpoint into a scene file."),
        Entry("check", ".sweeps:check_app", _SWEEPS, "Tell what is in a sweep, and what looks wrong."),
        Entry("draw", ".sweeps:draw", _SWEEPS, "Draw the image planes in space and a contact sheet of the frames."),
        Entry("convert", ".sweeps:convert", _SWEEPS, "Write a sweep in the layout of the released trainer."),
        Entry("train", ".train:train", _SWEEPS, "Train a scene from a tracked sweep."),
        Entry("eval", ".evaluate:evaluate", _SWEEPS, "Measure a scene on the held-out frames of a sweep."),
        Entry("scenes", ".remote:scenes_app", _REMOTE, "List, upload, download, delete and render scenes."),
        Entry(
            "datasets",
            ".remote:datasets_app",
            _REMOTE,
            "List, upload and delete the sweeps that trainings use.",
        ),
        Entry(
            "registrations",
            ".remote:registrations_app",
            _REMOTE,
            "List, upload and delete registrations of robots.",
        ),
        Entry(
            "jobs",
            ".jobs:command_app",
            _REMOTE,
            "Submit, watch and fetch trainings, evaluations and batch renderings.",
        ),
        Entry(
            "workers",
            ".remote:workers_app",
            _REMOTE,
            "List the workers of the jobs; pause, drain and resume them.",
        ),
        Entry("keys", ".administration:keys_app", _INSTALLATION, "Make, list and revoke API keys."),
        Entry("backup", ".administration:backup", _INSTALLATION, "Save scenes, datasets, jobs and their database."),
        Entry("restore", ".administration:restore", _INSTALLATION, "Make an installation what it was at a backup."),
        Entry("storage", ".administration:storage_app", _INSTALLATION, "Copy scenes into a bucket, or out of it."),
        Entry("audit", ".administration:audit", _INSTALLATION, "Print who did what: the audit log."),
    )


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Ultrasound from trained 3D Gaussian scenes: a probe pose goes in, a B-mode frame comes out.\n\n"
    "Lengths are in mm, angles in degrees; poses are rigid probe→scene transforms.",
    epilog=examples(
        "ultragray serve  # the console at http://127.0.0.1:8000, with a demo scene",
        "ultragray demo -o demo.ugr && ultragray render demo.ugr -o frames/",
        "ultragray check sweep/ && ultragray train sweep/ -o liver.ugr",
    ),
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from ultragray.installation import __version__

        typer.echo(f"ultragray {__version__}")
        raise typer.Exit


@app.callback()
def main(
    context: typer.Context,
    version: Annotated[bool, option("Print the version.", "--version", callback=_print_version, is_eager=True)] = False,
) -> None:
    """Look for environment variables that are misspelt, whatever the command; a service logs them itself."""
    from ultragray_service.cli.terminal import warn
    from ultragray_service.misspelt import unknown_variables

    if context.invoked_subcommand != "serve":
        for sentence in unknown_variables():
            warn(sentence)

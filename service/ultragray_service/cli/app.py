"""The command line `ultragray`: a table of commands, each imported when it is used; mistakes are told in one line."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from ultragray_service.cli.terminal import examples, interrupted_by_sigterm, option, warn

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


_PLUGINS = "ultragray.commands"  # group of the entry points of other packages, each a tuple of entries
_COMMANDS = {  # by the panels of the help
    "Serve": {
        "serve": (".serve:serve", "Serve scenes over HTTP and gRPC, until Ctrl-C or SIGTERM."),
        "worker": (".worker:worker", "Take jobs from the queue, one at a time, until Ctrl-C."),
    },
    "Scenes and frames": {
        "demo": (".scenes:demo", "Write a built-in demo scene: a spine, or an abdomen."),
        "show": (".scenes:show", "Print what a scene file or a sweep says about itself."),
        "render": (".render:render", "Render frames from poses into one file or a folder of PNGs."),
        "export": (".scenes:export", "Write a scene as PLY or as a checkpoint of the released code."),
        "localize": (".register:localize", "Find the pose of a real frame in a scene."),
        "plan": (".plan:plan", "Find where to look next: views that would teach a scene most."),
        "calibrate": (".register:calibrate_app", "Register a robot or tracker to a scene."),
        "label": (".labels:label", "Label the Gaussians of a scene by a NIfTI map or by painted frames."),
        "edit": (".editing:edit", "Move, cut, merge, relabel or thin a scene, or insert lesions, as a new one."),
        "from-labels": (".editing:from_labels", "Make a scene that nobody recorded, from a label map or meshes."),
        "motion": (".motion:motion", "Add a mode of motion to a scene: of a sweep, of a field, or built in."),
        "voxelize": (".scenes:voxelize", "Sample a scene on a grid: a NIfTI or NRRD volume, or a slice."),
        "slicer": (".scenes:slicer", "Write a scene file of 3D Slicer that shows a served scene live."),
        "import": (".scenes:import_scene", "Turn a PLY file or a released checkpoint into a scene file."),
    },
    "Sweeps and training": {
        "check": (".sweeps:check_app", "Tell what is in a sweep, and what looks wrong."),
        "draw": (".sweeps:draw", "Draw the image planes in space and a contact sheet of the frames."),
        "convert": (".sweeps:convert", "Write a sweep in the layout of the released trainer."),
        "train": (".train:train", "Train a scene from a tracked sweep."),
        "eval": (".evaluate:evaluate", "Measure a scene on the held-out frames of a sweep."),
    },
    "A running service (--address)": {
        "scenes": (".remote:scenes_app", "List, upload, download, delete and render scenes."),
        "datasets": (".remote:datasets_app", "List, upload and delete the sweeps that trainings use."),
        "live": (".live:live_app", "Record a sweep or a scanner; its scene grows meanwhile."),
        "recordings": (".remote:recordings_app", "Show, finish and give up recordings."),
        "registrations": (".remote:registrations_app", "List, upload and delete registrations of robots."),
        "jobs": (".jobs:command_app", "Submit, watch and fetch trainings, evaluations and batch renderings."),
        "workers": (".remote:workers_app", "List the workers of the jobs; pause, drain and resume them."),
    },
    "An installation's folders": {
        "keys": (".administration:keys_app", "Make, list and revoke API keys."),
        "backup": (".administration:backup", "Save scenes, datasets, jobs and their database."),
        "restore": (".administration:restore", "Make an installation what it was at a backup."),
        "storage": (".administration:storage_app", "Copy scenes into a bucket, or out of it."),
        "audit": (".administration:audit", "Print who did what: the audit log."),
    },
}


@cache
def _own() -> dict[str, Entry]:
    panels = _COMMANDS.items()
    return {name: Entry(name, app, panel, text) for panel, of in panels for name, (app, text) in of.items()}


@cache
def _all() -> dict[str, Entry]:
    """The own entries, then those of other packages; to find these takes some hundredths of a second."""
    entries = dict(_own())
    for point in entry_points(group=_PLUGINS):
        try:
            for entry in point.load():
                entries.setdefault(entry.name, entry)
        except ImportError as error:
            warn(f"the commands of {point.value} are left out: {error}")
    return entries


def _entry(name: str) -> Entry | None:
    return _own().get(name) or _all().get(name)


class _Loaded(Mapping[str, Any]):
    """Commands by name, each loaded when it is asked for."""

    def __getitem__(self, name: str) -> Any:
        return _all()[name].load()

    def __iter__(self) -> Iterator[str]:
        return iter(_all())

    def __len__(self) -> int:
        return len(_all())


class _Commands(TyperGroup):
    """A group whose commands are loaded when they run; lists of them need only the entries.

    Mistakes end the process with one line on stderr, `error: …`, and exit code 2. So do the errors of the project and
    of the file system.
    """

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands = _Loaded()  # type: ignore[assignment]  # nobody adds to it

    def list_commands(self, ctx: Any) -> list[str]:
        return [*_all()]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """A command as lists show it; what runs comes from `resolve_command`."""
        entry = _entry(cmd_name)
        return None if entry is None else TyperCommand(entry.name, help=entry.summary, rich_help_panel=entry.panel)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name, command, rest = super().resolve_command(ctx, args)
        entry = _entry(name or "")
        return name, command if entry is None else entry.load(), rest

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        windows_expand_args: bool = True,
        **extra: Any,
    ) -> Any:
        arguments = (args, prog_name or "ultragray", complete_var, False, windows_expand_args)  # also by `python -m`
        if not standalone_mode:
            return super().main(*arguments, **extra)
        try:
            code = super().main(*arguments, **extra)
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
            with interrupted_by_sigterm():
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
        parameters = [] if context is None else context.command.get_params(context)
        known = [name for one in parameters for name in one.opts if name.startswith("--")]
        near = get_close_matches(option, known, n=2)
        sentence = f"no such option: {option}" + (f"; did you mean {' or '.join(near)}?" if near else "")
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
    from ultragray_service.misspelt import unknown_variables

    if context.invoked_subcommand != "serve":
        for sentence in unknown_variables():
            warn(sentence)

"""The command line `ultragray`. Its commands stand in one table here; each is imported when it is used."""

from __future__ import annotations

from typing import Annotated

import typer

from ultragray_service.cli.group import Entry, LazyGroup
from ultragray_service.cli.style import examples

_SERVING, _SCENES, _SWEEPS = "Serve", "Scenes and frames", "Sweeps and training"
_REMOTE, _INSTALLATION = "A running service (--address)", "An installation's folders"


class _Commands(LazyGroup):
    entries = (
        Entry("serve", "serve", _SERVING, "Serve scenes over HTTP and gRPC, until Ctrl-C or SIGTERM."),
        Entry("worker", "worker", _SERVING, "Take jobs from the queue, one at a time, until Ctrl-C."),
        Entry("demo", "scenes.demo", _SCENES, "Write the built-in demo scene."),
        Entry("show", "scenes.show", _SCENES, "Print what a scene file or a sweep says about itself."),
        Entry("render", "scenes.render", _SCENES, "Render frames from poses into one file or a folder of PNGs."),
        Entry("export", "scenes.export", _SCENES, "Write a scene as PLY or as a checkpoint of the released code."),
        Entry("localize", "scenes.localize", _SCENES, "Find the pose of a real frame in a scene."),
        Entry("calibrate", "scenes.calibrate", _SCENES, "Register a robot or tracker to a scene."),
        Entry("voxelize", "scenes.voxelize", _SCENES, "Sample a scene on a grid: a NIfTI or NRRD volume, or a slice."),
        Entry("slicer", "scenes.slicer", _SCENES, "Write a scene file of 3D Slicer that shows a served scene live."),
        Entry("import", "scenes.importing", _SCENES, "Turn a PLY file or a released checkpoint into a scene file."),
        Entry("check", "sweeps.check", _SWEEPS, "Tell what is in a sweep, and what looks wrong."),
        Entry("draw", "sweeps.draw", _SWEEPS, "Draw the image planes in space and a contact sheet of the frames."),
        Entry("convert", "sweeps.convert", _SWEEPS, "Write a sweep in the layout of the released trainer."),
        Entry("train", "studies.train", _SWEEPS, "Train a scene from a tracked sweep."),
        Entry("eval", "studies.eval", _SWEEPS, "Measure a scene on the held-out frames of a sweep."),
        Entry("compare", "studies.compare", _SWEEPS, "Compare this and other methods on the same frames."),
        Entry("report", "studies.report", _SWEEPS, "Train, measure and compare; write one HTML page."),
        Entry("bench", "studies.bench", _SWEEPS, "Measure the kernel and the service on this machine."),
        Entry("scenes", "remote.scenes", _REMOTE, "List, upload, download, delete and render scenes."),
        Entry("datasets", "remote.datasets", _REMOTE, "List, upload and delete the sweeps that trainings use."),
        Entry("registrations", "remote.registrations", _REMOTE, "List, upload and delete registrations of robots."),
        Entry("jobs", "remote.jobs", _REMOTE, "Submit, watch and fetch trainings, evaluations and batch renderings."),
        Entry("workers", "remote.workers", _REMOTE, "List the workers of the jobs; pause, drain and resume them."),
        Entry("keys", "administration.keys", _INSTALLATION, "Make, list and revoke API keys."),
        Entry("backup", "administration.backup", _INSTALLATION, "Save scenes, datasets, jobs and their database."),
        Entry("restore", "administration.restore", _INSTALLATION, "Make an installation what it was at a backup."),
        Entry("storage", "administration.storage", _INSTALLATION, "Copy scenes into a bucket, or out of it."),
        Entry("audit", "administration.audit", _INSTALLATION, "Print who did what: the audit log."),
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
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Look for environment variables that are misspelt, whatever the command; a service logs them itself."""
    from ultragray_service.cli.style import warn
    from ultragray_service.misspelt import unknown_variables

    if context.invoked_subcommand != "serve":
        for sentence in unknown_variables():
            warn(sentence)

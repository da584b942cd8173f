"""The command line `ultragray`: serving, rendering, datasets, training, evaluation, export, benchmarks.

Only names and help live here; what a command needs (torch, FastAPI) is imported when it runs, so that
`--help` is instant.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

import ultragray
from ultragray.errors import InvalidArgument, UltragrayError
from ultragray.installation import missing_extra
from ultragray.interchange.exports.formats import DTYPES, FORMATS
from ultragray.samplers import Sampler
from ultragray.settings import FrameSettings

from ..settings import ENVIRONMENT_PREFIX, Settings
from . import convert as cli_convert
from . import dataset as cli_dataset
from . import eval as cli_eval
from . import report as cli_report
from . import train as cli_train
from . import worker as cli_worker
from .administration import audit as cli_audit
from .administration import backup as cli_backup
from .administration import keys as cli_keys
from .administration import workers as cli_workers
from .jobs import commands as cli_jobs
from .options import FieldsOf, with_options

USER_ERROR = 2  # the exit code of a mistake that the caller can mend


class _Commands(TyperGroup):
    """A group that turns the errors of the project and of the file system into one red line and exit code 2."""

    def invoke(self, context: Any) -> Any:
        try:
            return super().invoke(context)
        except BrokenPipeError:  # `ultragray info scene.ugr | head`: nobody is left to tell
            raise
        except UltragrayError as error:
            message = error.detail
        except ModuleNotFoundError as error:
            message = missing_extra(error, "this command").detail
        except OSError as error:
            message = f"{error.filename}: {error.strerror}" if error.filename and error.strerror else str(error)
        typer.secho(f"error: {message}", fg=typer.colors.RED, err=True)
        raise typer.Exit(USER_ERROR)


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Ultrasound from trained 3D Gaussian scenes: a probe pose goes in, a B-mode frame comes out.",
)

Scene = Annotated[Path, typer.Argument(help="Scene file (.ugr).", show_default=False)]


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"ultragray {ultragray.__version__}")
        raise typer.Exit


@app.callback()
def main(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Lengths are in mm, angles in degrees; poses are rigid probe→scene transforms."""


@app.command(epilog="Every other setting has an environment variable: see docs/interfaces.md.")
@with_options
def serve(
    scenes: Annotated[
        list[Path] | None,
        typer.Argument(help="Scene files to serve alone, without those of a data folder.", show_default=False),
    ] = None,
    *,
    options: Annotated[
        dict[str, Any],
        FieldsOf(
            Settings,
            *("data_folder", "artifact_folder", "host", "insecure", "http_port", "grpc_port", "igtl_port"),
            *("tls_certificate", "tls_key", "tls_client_ca"),
            *("processes", "threads_per_process", "backend", "log_level"),
            environment=ENVIRONMENT_PREFIX,
        ),
    ],
) -> None:
    """Serve scenes over HTTP and gRPC, in the foreground, until Ctrl-C or SIGTERM."""
    from .serve import serve_scenes

    serve_scenes(scenes or [], options)


@app.command()
@with_options
def render(
    scene: Scene,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help=f"A file ({', '.join(one.suffix for one in FORMATS.values())}), or a folder for PNGs "
            "(frame_00000_bmode.png).",
        ),
    ],
    sampler: Sampler | None,
    settings: FrameSettings,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="Poses in mm: .npy or .json, [P, 4, 4] or [P, 3, 4].",
            show_default="the scene's training poses",
        ),
    ] = None,
    dtype: Annotated[
        str | None, typer.Option(help=f"{' or '.join(DTYPES)}, of a file.", show_default="the format's own")
    ] = None,
    backend: Annotated[str, typer.Option(help="auto, cpu, cuda or reference.")] = "auto",
    threads: Annotated[int, typer.Option(min=0, help="Render threads; 0: all cores.")] = 0,
) -> None:
    """Render frames from poses into one file or a folder of PNGs."""
    from .render import render_frames

    typer.echo(render_frames(scene, output, poses, sampler, settings, dtype=dtype, backend=backend, threads=threads))


@app.command()
def info(
    scene: Scene,
    json: Annotated[bool, typer.Option("--json", help="One JSON object, for scripts.")] = False,
) -> None:
    """Print what a scene file says about itself."""
    from .info import print_json, print_table

    (print_json if json else print_table)(scene)


app.add_typer(cli_dataset.dataset_app, name="dataset")
app.add_typer(cli_jobs.jobs_app, name="jobs")
app.add_typer(cli_workers.workers_app, name="workers")
app.add_typer(cli_keys.keys_app, name="keys")
app.command()(cli_train.train)
app.command("eval")(cli_eval.evaluate)
app.command()(cli_eval.compound)
app.command()(cli_report.report)
app.command()(cli_convert.export)
app.command()(cli_convert.import_ply)
app.command()(cli_convert.import_checkpoint)
app.command()(cli_worker.worker)
app.command()(cli_audit.audit)
app.command()(cli_backup.backup)
app.command()(cli_backup.restore)


@app.command()
def demo(
    output: Annotated[Path, typer.Option("--output", "-o", help="Scene file to write (.ugr).")] = Path("demo.ugr"),
) -> None:
    """Write the built-in demo scene."""
    from ultragray.demo import copy_demo_scene
    from ultragray.scene_info import read_header

    from .output import SCENE_SUFFIX, check_writable

    check_writable(output, SCENE_SUFFIX)
    copy_demo_scene(output)
    info = read_header(output).info
    typer.echo(f"wrote {output}: {info.dataset_name}, {info.gaussian_count:,} Gaussians")


@app.command()
def bench(
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Also write the figures as JSON.", show_default=False),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer repetitions: a minute instead of several.")] = False,
    train: Annotated[bool, typer.Option("--train", help="Measure a training step and its parts instead.")] = False,
    jobs: Annotated[
        bool, typer.Option("--jobs", help="Measure a long list of jobs, and frames beside a training, instead.")
    ] = False,
    clients: Annotated[
        bool, typer.Option("--clients", help="Measure what control loops, pages and scripts get instead.")
    ] = False,
    kernel_details: Annotated[
        bool,
        typer.Option("--kernel-details", help="Measure the parts of a frame in the kernel, and its work, instead."),
    ] = False,
    backend: Annotated[str, typer.Option(help="cpu, or cuda: the first GPU.")] = "cpu",
) -> None:
    """Measure the kernel and the service on this machine and print a table."""
    from ..bench.command import chosen_bench
    from .output import check_writable

    if output is not None:
        check_writable(output)
    wanted = {"train": train, "jobs": jobs, "clients": clients, "kernel-details": kernel_details}
    chosen = [name for name, is_wanted in wanted.items() if is_wanted]
    if len(chosen) > 1:
        raise InvalidArgument("give one of --train, --jobs, --clients and --kernel-details", field=chosen[0])
    chosen_bench(chosen[0] if chosen else "frames", backend)(output, quick)

"""`ultragray render`: everything that can be wrong is found before torch is imported."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ultragray.errors import InvalidArgument
from ultragray.exchange.batches import SHARD_FRAMES
from ultragray.exchange.exports.formats import DTYPES, FORMATS, check_format, exporter_class, format_of
from ultragray.samplers import Sampler
from ultragray.settings import FrameSettings
from ultragray_service.cli.options import poses_option, with_options
from ultragray_service.cli.output import OR_A_FOLDER, check_ending, check_file, check_folder, is_folder_name
from ultragray_service.cli.style import (
    COMPUTE,
    OUTPUT,
    Backend,
    Force,
    Json,
    SceneFile,
    command_group,
    examples,
    output_option,
    tell,
)

SHARDS = "Shards"
SUFFIXES = tuple(one.suffix for one in FORMATS.values())
command_app = command_group()


@command_app.command(
    epilog=examples(
        "ultragray render liver.ugr -o frames.npz  # the training poses",
        "ultragray render liver.ugr -o pictures/ --poses path.npy  # a folder of PNGs",
        "ultragray render liver.ugr -o augmented.tar --sampler around --count 500 --translation-mm 3",
        "ultragray render liver.ugr -o labels.h5 --outputs bmode,labels --min-confidence 0.8",
        "ultragray render liver.ugr -o s3://frames/liver --sampler around --count 10000000 --on ray://head:10001",
    )
)
@with_options
def render(
    scene: SceneFile,
    output: Annotated[
        str,
        output_option(
            f"A file ({', '.join(SUFFIXES)}), or a folder for PNGs (frame_00000_bmode.png); with --on a folder or "
            "s3://BUCKET/PREFIX for shards (frames-000000.tar)."
        ),
    ],
    dtype: Annotated[
        str | None,
        typer.Option(
            help=f"{' or '.join(DTYPES)}, of a file.", show_default="the format's own", rich_help_panel=OUTPUT
        ),
    ] = None,
    force: Force = False,
    json: Json = False,
    poses: Annotated[Path | None, poses_option(default="the scene's training poses")] = None,
    *,
    sampler: Sampler | None,
    settings: FrameSettings,
    backend: Backend = "auto",
    threads: Annotated[
        int, typer.Option(min=0, help="Render threads; 0: all cores, of a shard one.", rich_help_panel=COMPUTE)
    ] = 0,
    on: Annotated[
        str | None,
        typer.Option(
            metavar="ray|ray://HEAD:PORT",
            help="Render in shards on a Ray cluster, or on one of this machine; what is there already is kept.",
            show_default=False,
            rich_help_panel=SHARDS,
        ),
    ] = None,
    shard_frames: Annotated[
        int | None,
        typer.Option(min=1, help="Frames of a shard.", show_default=f"{SHARD_FRAMES:,}", rich_help_panel=SHARDS),
    ] = None,
) -> None:
    """Each frame comes with its pose and with how far it can be trusted. Lengths are in mm, angles in degrees."""
    if on is not None:
        from ultragray_service.cli.scenes.sharding import Shards, render_shards

        shards = Shards.prepared(scene, poses, sampler, settings, dtype=dtype, shard_frames=shard_frames)
        told = render_shards(shards, output, on, backend=backend, threads=threads)
        tell(told.in_words(), told.document(), as_json=json)
        return
    if shard_frames is not None:
        raise InvalidArgument("--shard-frames is of shards: name an engine with --on", field="shard_frames")
    from ultragray_service.cli.scenes.rendering import Task, render_frames

    path = Path(output)
    format = checked_format(path, settings, dtype, force=force)
    task = Task.prepared(scene, poses, sampler, settings)
    found = render_frames(task, path, format, dtype=dtype, backend=backend, threads=threads)
    tell(found.in_words(), found.document(), as_json=json)


def checked_format(output: Path, settings: FrameSettings, dtype: str | None, *, force: bool) -> str | None:
    """The format that the name of the output stands for; None for a folder of PNGs.

    Raises InvalidArgument for an output that cannot or may not be written, ExtraMissing where the format's package is
    not installed.
    """
    format = format_of(output.name)
    if format is None and not is_folder_name(output):
        check_ending(output, SUFFIXES, otherwise=OR_A_FOLDER)
    if format is None:
        if dtype is not None:
            raise InvalidArgument("--dtype must be left out for PNGs: they hold uint8", field="dtype")
        check_folder(output, force=force)
        return None
    check_file(output, force=force)
    check_format(format, settings.outputs, dtype)
    exporter_class(format)
    return format

"""`ultragray convert`: a sweep in the layout of the released trainer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ultragray.datasets.source import SourceOptions
from ultragray.errors import InvalidArgument
from ultragray.scene_info import SceneHeader, read_header
from ultragray_service.cli.options import with_options
from ultragray_service.cli.output import check_folder
from ultragray_service.cli.style import Force, Json, command_group, examples, output_option, tell
from ultragray_service.cli.sweeps.source import SweepArgument, read_dataset

if TYPE_CHECKING:
    from ultragray.datasets import Dataset

command_app = command_group()


@command_app.command(
    epilog=examples(
        "ultragray convert scan.igs.mha --device-set plus.xml -o sweep/",
        "ultragray convert sweep/ --poses-of liver.ugr -o corrected/  # with the poses that the training corrected",
    )
)
@with_options
def convert(
    sweep: SweepArgument,
    output: Annotated[Path, output_option("Folder for conf.json and the .npy files.")],
    force: Force = False,
    json: Json = False,
    poses_of: Annotated[
        Path | None,
        typer.Option(
            metavar="SCENE",
            help="A scene trained from it: its corrected training poses are written.",
            show_default=False,
        ),
    ] = None,
    *,
    source: SourceOptions,
) -> None:
    """Every other command reads the folder as a sweep: crop, size and split are then done once."""
    from ultragray.datasets.released import write_released

    check_folder(output, force=force)
    header = None if poses_of is None else read_header(poses_of)
    read = read_dataset(sweep, source)
    if header is not None:
        read = _with_poses_of(poses_of, header, read)
    write_released(read, output, replace=force)
    tell(
        f"wrote {output}: {len(read.train)} training and {len(read.val)} held-out frames of "
        f"{read.train.width}x{read.train.height}, {read.probe}",
        {
            "output": str(output),
            "sha256": read.sha256,
            "training_frames": len(read.train),
            "held_out_frames": len(read.val),
            "image_height": read.train.height,
            "image_width": read.train.width,
        },
        as_json=json,
    )


def _with_poses_of(path: Path | None, header: SceneHeader, dataset: Dataset) -> Dataset:
    """The dataset with a scene's corrected training poses."""
    if header.info.dataset_sha256 != dataset.sha256:
        raise InvalidArgument(
            f"{path} was trained from {header.info.dataset_name or 'other data'}, not from {dataset.name} split as "
            "here: give the sweep and the options that it was trained with",
            field="poses_of",
        )
    return replace(dataset, train=replace(dataset.train, poses=header.training_poses))

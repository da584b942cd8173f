"""The argument and the options by which every command names a dataset."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ultragray.datasets.source import FORMATS, PHANTOM, SourceOptions, load_dataset

if TYPE_CHECKING:
    from ultragray.datasets import Dataset
    from ultragray.datasets.checks import DatasetReport
    from ultragray.scene_info import SceneInfo

DatasetArgument = Annotated[
    str,
    typer.Argument(
        metavar="DATASET",
        help=f"One of: {'; '.join(one.meaning for one in FORMATS.values())}.",
        show_default=False,
    ),
]
TrainFrames = Annotated[
    str | None,
    typer.Option(
        metavar="RANGES",
        help="Frames to train from, such as 0:90 or 0:90,100:120:2: places in the training file, or in the sequence.",
        show_default="the dataset's own split; of a sequence all that are not held out",
    ),
]
ValFrames = Annotated[
    str | None,
    typer.Option(
        metavar="RANGES",
        help="Frames to hold out, counted likewise.",
        show_default="the dataset's own split; of a sequence every fifth",
    ),
]
Frames = Annotated[
    str | None,
    typer.Option(metavar="RANGES", help="Frames of a sequence to read at all.", show_default="all with a valid pose"),
]
DeviceSet = Annotated[
    Path | None,
    typer.Option(help="PLUS device set (.xml) with the calibration ImageToProbe of a sequence.", show_default=False),
]
Crop = Annotated[
    str | None,
    typer.Option(
        metavar="COLUMNS,ROWS",
        help="Region of a sequence's image that shows ultrasound, such as 188:632,12:600 (ends left out).",
        show_default="the whole image",
    ),
]
ImageSize = Annotated[
    str | None,
    typer.Option(metavar="WIDTHxHEIGHT", help="Resize the frames, such as 192x256.", show_default="as they are stored"),
]


def read_dataset(
    source: str,
    train_frames: str | None,
    val_frames: str | None,
    frames: str | None,
    device_set: Path | None,
    crop: str | None,
    image_size: str | None,
) -> Dataset:
    """The dataset that a command's argument and options name. Raises DatasetInvalid and InvalidArgument."""
    if source == PHANTOM:
        typer.echo("simulating the phantom …", err=True)
    return load_dataset(
        source,
        SourceOptions(
            train_frames=train_frames,
            val_frames=val_frames,
            frames=frames,
            device_set=device_set,
            crop=crop,
            image_size=image_size,
        ),
    )


def warnings_of(report: DatasetReport) -> list[str]:
    """What looks wrong about a dataset, the part that it is about first."""
    return list(report.labelled_warnings)


def warn_about_dataset(dataset: Dataset) -> None:
    """Tells on stderr what `dataset check` warns of."""
    from ultragray.datasets.checks import check_dataset

    _warn(warnings_of(check_dataset(dataset)))


def check_scene_fits(info: SceneInfo, dataset: Dataset) -> None:
    """Tells on stderr what makes figures of a scene on a dataset doubtful; raises as `check_same_origin`."""
    from ultragray.evaluation.scoring import check_same_origin

    _warn(check_same_origin(info, dataset))


def _warn(warnings: Iterable[str]) -> None:
    for text in warnings:
        typer.secho(f"warning: {text}", fg=typer.colors.YELLOW, err=True)

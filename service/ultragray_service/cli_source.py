"""The argument and the options by which every command names a dataset."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from ultragray.datasets import Dataset

DatasetArgument = Annotated[
    str,
    typer.Argument(
        metavar="DATASET",
        help="Folder with conf.json and .npy files (or its conf.json), a PLUS sequence (.mha, .mhd, .nrrd), or the "
        "word phantom.",
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
    from ultragray.datasets.source import SourceOptions, load_dataset

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

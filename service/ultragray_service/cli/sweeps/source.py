"""The sweep that a command names: its argument, reading it, and what is said about it on stderr."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ultragray.datasets.source import FORMATS, PHANTOM, SourceOptions, format_of, load_dataset
from ultragray_service.cli.progress import working
from ultragray_service.cli.style import warn

if TYPE_CHECKING:
    from ultragray.datasets import Dataset
    from ultragray.scene_info import SceneInfo

SWEEP_MEANING = "; ".join(one.meaning for one in FORMATS.values())
SweepArgument = Annotated[str, typer.Argument(metavar="SWEEP", help=f"One of: {SWEEP_MEANING}.", show_default=False)]


def check_source(source: str) -> None:
    """Raise DatasetInvalid where a source is in no known format or is not there; reads nothing."""
    format_of(source)


def read_dataset(source: str, options: SourceOptions) -> Dataset:
    """The dataset that a command's argument and options name. Raises DatasetInvalid and InvalidArgument."""
    if source == PHANTOM:
        typer.echo("simulating the phantom …", err=True)
        return load_dataset(source, options)
    check_source(source)
    with working(f"reading {Path(source).name} …"):
        return load_dataset(source, options)


def warn_about_dataset(dataset: Dataset) -> None:
    """Say on stderr what `ultragray check` warns of."""
    from ultragray.datasets.checks import check_dataset

    for text in check_dataset(dataset).labelled_warnings:
        warn(text)


def check_scene_fits(info: SceneInfo, dataset: Dataset) -> None:
    """Say on stderr what makes figures of a scene on a dataset doubtful; raises as `check_same_origin`."""
    from ultragray.learn.evaluation.scoring import check_same_origin

    for text in check_same_origin(info, dataset):
        warn(text)

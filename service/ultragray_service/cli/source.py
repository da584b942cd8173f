"""The argument by which commands name a dataset, and their warnings about it."""

from __future__ import annotations

from collections.abc import Iterable
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


def read_dataset(source: str, options: SourceOptions) -> Dataset:
    """The dataset that a command's argument and options name. Raises DatasetInvalid and InvalidArgument."""
    if source == PHANTOM:
        typer.echo("simulating the phantom …", err=True)
    return load_dataset(source, options)


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

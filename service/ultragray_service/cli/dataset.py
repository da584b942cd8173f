"""`ultragray dataset check | convert | show`, and the dataset that other commands name."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ultragray.datasets.source import FORMATS, PHANTOM, SourceOptions, load_dataset
from ultragray.errors import InvalidArgument

from .options import with_options

if TYPE_CHECKING:
    from ultragray.datasets import Dataset
    from ultragray.datasets.checks import DatasetReport, SweepReport
    from ultragray.scene_info import SceneInfo

DatasetArgument = Annotated[
    str,
    typer.Argument(
        metavar="DATASET",
        help=f"One of: {'; '.join(one.meaning for one in FORMATS.values())}.",
        show_default=False,
    ),
]
dataset_app = typer.Typer(no_args_is_help=True, help="Look at a tracked sweep, check it, convert it.")


def read_dataset(source: str, options: SourceOptions) -> Dataset:
    """The dataset that a command's argument and options name. Raises DatasetInvalid and InvalidArgument."""
    if source == PHANTOM:
        typer.echo("simulating the phantom …", err=True)
    return load_dataset(source, options)


def warn_about_dataset(dataset: Dataset) -> None:
    """Say on stderr what `dataset check` warns of."""
    from ultragray.datasets.checks import check_dataset

    _warn(check_dataset(dataset).labelled_warnings)


def check_scene_fits(info: SceneInfo, dataset: Dataset) -> None:
    """Say on stderr what makes figures of a scene on a dataset doubtful; raises as `check_same_origin`."""
    from ultragray.evaluation.scoring import check_same_origin

    _warn(check_same_origin(info, dataset))


def _warn(warnings: Iterable[str]) -> None:
    for text in warnings:
        typer.secho(f"warning: {text}", fg=typer.colors.YELLOW, err=True)


@dataset_app.command()
@with_options
def check(
    dataset: DatasetArgument,
    json: Annotated[bool, typer.Option("--json", help="One JSON object, for scripts.")] = False,
    *,
    source: SourceOptions,
) -> None:
    """Tell what is in a dataset, and what looks wrong. Exit code 2 where it cannot be used at all."""
    from json import dumps

    from ultragray.contract import to_dict
    from ultragray.datasets.checks import check_dataset

    report = check_dataset(read_dataset(dataset, source))
    if json:
        typer.echo(dumps(to_dict(report), indent=2))
    else:
        _print_report(report)


@dataset_app.command()
@with_options
def convert(
    dataset: DatasetArgument,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for conf.json and the .npy files.", show_default=False)
    ],
    poses_of: Annotated[
        Path | None,
        typer.Option(metavar="SCENE", help="A scene trained from it: its corrected training poses are written."),
    ] = None,
    *,
    source: SourceOptions,
) -> None:
    """Write a dataset in the layout of the released trainer."""
    from ultragray.datasets.released import write_released

    read = read_dataset(dataset, source)
    if poses_of is not None:
        read = _with_poses_of(poses_of, read)
    write_released(read, output)
    typer.echo(
        f"wrote {output}: {len(read.train)} training and {len(read.val)} held-out frames of "
        f"{read.train.width}x{read.train.height}, {read.probe}"
    )


def _with_poses_of(path: Path, dataset: Dataset) -> Dataset:
    """The dataset with a scene's corrected training poses."""
    from ultragray.scene_info import read_header

    header = read_header(path)
    if header.info.dataset_sha256 != dataset.sha256:
        raise InvalidArgument(
            f"{path} was trained from {header.info.dataset_name or 'other data'}, not from {dataset.name} split as "
            "here: give the dataset and the options that it was trained with",
            field="poses_of",
        )
    return replace(dataset, train=replace(dataset.train, poses=header.training_poses))


@dataset_app.command()
@with_options
def show(
    dataset: DatasetArgument,
    output: Annotated[Path, typer.Option("--output", "-o", help="Picture to write (.png).", show_default=False)],
    *,
    source: SourceOptions,
) -> None:
    """Draw the image planes in space and a contact sheet of the frames."""
    from ultragray.datasets.pictures import draw_dataset
    from ultragray.errors import InvalidArgument

    from .output import check_writable

    if output.suffix.lower() != ".png":
        raise InvalidArgument(f"output must be a .png file, got {output}", field="output")
    check_writable(output)
    draw_dataset(read_dataset(dataset, source), output)
    typer.echo(f"wrote {output}")


def _print_report(report: DatasetReport) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    parts = [report.train] if report.val is None else [report.train, report.val]
    table = Table(box=None, pad_edge=False)
    table.add_column()
    for name in ("train", "val")[: len(parts)]:
        table.add_column(name, justify="right")
    described = [_describe(part) for part in parts]
    for label in described[0]:
        table.add_row(label, *(column[label] for column in described))
    console = Console()
    console.print(f"{escape(report.name)}: {report.probe}", soft_wrap=True, highlight=False)
    console.print(table)
    if report.val_distance_max_mm is not None:
        console.print(
            f"held-out frames lie {report.val_distance_median_mm:.2f} mm (median) to {report.val_distance_max_mm:.2f} "
            f"mm and up to {report.val_angle_max_deg:.2f}° from the nearest training frame",
            soft_wrap=True,
        )
    warnings = report.labelled_warnings
    for warning in warnings:
        console.print(f"[yellow]warning:[/] {escape(warning)}", soft_wrap=True)
    if not warnings:
        console.print("[green]nothing suspicious[/]")


def _describe(part: SweepReport) -> dict[str, str]:
    return {
        "frames": str(part.frames),
        "image, width x height": f"{part.width} x {part.height}",
        "pixel, lateral x axial, mm": f"{part.pixel_lateral_mm:.4g} x {part.pixel_axial_mm:.4g}",
        "extent x, mm": _range(part, 0),
        "extent y, mm": _range(part, 1),
        "extent z, mm": _range(part, 2),
        "path of the probe, mm": f"{part.path_mm:.1f}",
        "step, median and largest, mm": f"{part.step_median_mm:.2f}, {part.step_max_mm:.2f}",
        "largest turn in a step, °": f"{part.step_max_deg:.2f}",
        "largest angle between frames, °": f"{part.tilt_deg:.1f}",
        "tilt about lateral, elevation, axial, °": ", ".join(f"{angle:.1f}" for angle in part.tilt_range_deg),
        f"crossed voxels of {part.voxel_mm:.3g} mm, mL": f"{part.swept_ml:.1f}",
        "their share of the box around": f"{part.coverage:.0%}",
    }


def _range(part: SweepReport, axis: int) -> str:
    return f"{part.extent_min_mm[axis]:.1f} … {part.extent_max_mm[axis]:.1f}"

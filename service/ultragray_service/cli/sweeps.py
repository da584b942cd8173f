"""Commands on tracked sweeps: check, draw, convert; and how every command reads the sweep that it names."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ultragray.contract import to_dict
from ultragray.datasets.source import FORMATS, PHANTOM, SourceOptions, format_of, load_dataset
from ultragray.errors import InvalidArgument
from ultragray.scene.info import read_header
from ultragray_service.cli.options import with_options
from ultragray_service.cli.terminal import (
    Force,
    Json,
    argument,
    check_file,
    check_folder,
    command_group,
    examples,
    option,
    output_option,
    single,
    tell,
    to_json,
    warn,
    working,
)

if TYPE_CHECKING:
    from ultragray.datasets import Dataset
    from ultragray.datasets.checks import DatasetReport, SweepReport
    from ultragray.scene.info import SceneInfo


SWEEP_MEANING = "; ".join(one.meaning for one in FORMATS.values())
SweepArgument = Annotated[str, argument(f"One of: {SWEEP_MEANING}.", metavar="SWEEP")]


def check_source(source: str) -> None:
    """Raise DatasetInvalid where a source is in no known format or is not there; reads nothing."""
    format_of(source)


def read_dataset(source: str, options: SourceOptions) -> Dataset:
    if source == PHANTOM:
        typer.echo("simulating the phantom …", err=True)
        return load_dataset(source, options)
    check_source(source)
    with working(f"reading {Path(source).name} …"):
        return load_dataset(source, options)


def warn_about_dataset(dataset: Dataset) -> None:
    from ultragray.datasets.checks import check_dataset

    for text in check_dataset(dataset).warnings:
        warn(text)


def check_scene_fits(info: SceneInfo, dataset: Dataset) -> None:
    """Say on stderr what makes figures of a scene on a dataset doubtful; raises as `check_same_origin`."""
    from ultragray.learn.evaluation.scoring import check_same_origin

    for text in check_same_origin(info, dataset):
        warn(text)


check_app = command_group()


@check_app.command(
    epilog=examples(
        "ultragray check sweep/",
        "ultragray check scan.igs.mha --device-set plus.xml --crop 188:632,12:600",
        "ultragray check phantom --json",
    )
)
@with_options
def check(sweep: SweepArgument, json: Json = False, *, source: SourceOptions) -> None:
    """Warnings leave the choice to you; exit code 2: the sweep cannot be used at all."""
    from ultragray.datasets.checks import check_dataset

    report = check_dataset(read_dataset(sweep, source))
    if json:
        typer.echo(to_json(to_dict(report)))
    else:
        _print_report(report)


def _print_report(report: DatasetReport) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    parts = [report.train] if report.val is None else [report.train, report.val]
    table = Table(box=None, pad_edge=False)
    table.add_column()
    for name in ("train", "val")[: len(parts)]:
        table.add_column(name, justify="right")
    columns = [_describe(part) for part in parts]
    for label in columns[0]:
        table.add_row(label, *(column[label] for column in columns))
    console = Console()
    console.print(f"{escape(report.name)}: {report.probe}", soft_wrap=True, highlight=False)
    console.print(table)
    if report.val_distance_max_mm is not None:
        console.print(
            f"held-out frames lie {report.val_distance_median_mm:.2f} mm (median) to {report.val_distance_max_mm:.2f} "
            f"mm and up to {report.val_angle_max_deg:.2f}° from the nearest training frame",
            soft_wrap=True,
        )
    for link in report.chain.links:
        console.print(escape(str(link)), soft_wrap=True, highlight=False)
    if report.chain.left_out:
        console.print(f"no part of it: {escape(', '.join(report.chain.left_out))}", soft_wrap=True, highlight=False)
    for warning in report.warnings:
        console.print(f"[yellow]warning:[/] {escape(warning)}", soft_wrap=True)
    if not report.warnings:
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
        "crossed voxels, mL (voxel, mm)": f"{part.swept_ml:.1f} ({part.voxel_mm:.3g})",
        "their share of the box around": f"{part.coverage:.0%}",
    }


def _range(part: SweepReport, axis: int) -> str:
    return f"{part.extent_min_mm[axis]:.1f} … {part.extent_max_mm[axis]:.1f}"


@single("ultragray draw sweep/ -o sweep.png")
@with_options
def draw(
    sweep: SweepArgument,
    output: Annotated[Path, output_option("Picture to write (.png).")],
    force: Force = False,
    json: Json = False,
    *,
    source: SourceOptions,
) -> None:
    """A mirrored image, a turned calibration or a jump of the tracker is seen at once."""
    check_file(output, [".png"], force=force)
    check_source(sweep)
    from ultragray.datasets.pictures import draw_dataset

    draw_dataset(read_dataset(sweep, source), output)
    tell(f"wrote {output}", {"output": str(output)}, as_json=json)


@single(
    "ultragray convert scan.igs.mha --device-set plus.xml -o sweep/",
    "ultragray convert sweep/ --poses-of liver.ugr -o corrected/  # with the poses that the training corrected",
)
@with_options
def convert(
    sweep: SweepArgument,
    output: Annotated[Path, output_option("Folder for conf.json and the .npy files.")],
    force: Force = False,
    json: Json = False,
    poses_of: Annotated[
        Path | None,
        option("A scene trained from it: the poses that it was trained on are written.", metavar="SCENE", shown=False),
    ] = None,
    anonymize: Annotated[
        bool,
        option("Leave out names: the source's, and text burnt into the pixels, which becomes black.", "--anonymize"),
    ] = False,
    *,
    source: SourceOptions,
) -> None:
    """Every other command reads the folder as a sweep: crop, size and split are then done once."""
    from ultragray.datasets.released import write_released

    check_folder(output, force=force)
    if poses_of is not None:
        read_header(poses_of)
    dataset = read_dataset(sweep, source)
    if poses_of is not None:
        dataset = _with_poses_of(poses_of, dataset)
    marks = 0
    if anonymize:
        from ultragray.datasets.checks import without_names

        dataset, marks = without_names(dataset)
    write_released(dataset, output, replace=force)
    tell(
        f"wrote {output}: {len(dataset.train)} training and {len(dataset.val)} held-out frames of "
        f"{dataset.train.width}x{dataset.train.height}, {dataset.probe}"
        + (f"; {marks} marks in the pixels are black now: look at them" if anonymize else ""),
        {
            "output": str(output),
            "sha256": dataset.sha256,
            "training_frames": len(dataset.train),
            "held_out_frames": len(dataset.val),
            "image_height": dataset.train.height,
            "image_width": dataset.train.width,
            **({"blackened_marks": marks} if anonymize else {}),
        },
        as_json=json,
    )


def _with_poses_of(path: Path, dataset: Dataset) -> Dataset:
    """The dataset with the poses that a scene was trained on; held-out frames are moved likewise."""
    from ultragray.learn.training.poses import held_out_on_path
    from ultragray.scene.gaussians import GaussianScene

    scene = GaussianScene.load(path)
    if scene.info.dataset_sha256 != dataset.sha256:
        raise InvalidArgument(
            f"{path} was trained from {scene.info.dataset_name or 'other data'}, not from {dataset.name} split as "
            "here: give the sweep and the options that it was trained with",
            field="poses_of",
        )
    held_out = held_out_on_path(dataset, scene)
    if held_out is None:
        held_out = replace(dataset.val, poses=scene.poses_at_rest(dataset.val.poses))
    return replace(dataset, train=replace(dataset.train, poses=scene.at_rest().training_poses), val=held_out)

"""`ultragray check`: what is in a sweep, and what looks wrong about it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from ultragray.contract import to_dict
from ultragray.datasets.source import SourceOptions
from ultragray_service.cli.options import with_options
from ultragray_service.cli.style import Json, command_group, examples, to_json
from ultragray_service.cli.sweeps.source import SweepArgument, read_dataset

if TYPE_CHECKING:
    from ultragray.datasets.checks import DatasetReport, SweepReport

command_app = command_group()


@command_app.command(
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

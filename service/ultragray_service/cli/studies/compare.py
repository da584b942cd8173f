"""`ultragray compare`: what classical methods reach on the same held-out frames as a scene."""

from __future__ import annotations

import enum
from typing import Annotated

import typer

from ultragray.datasets.source import SourceOptions

from ..options import with_options
from ..progress import working
from ..style import Json, command_group, examples, to_json
from ..sweeps.source import SweepArgument, check_source, read_dataset
from .tables import print_metrics, print_speckle

command_app = command_group()

VoxelMm = Annotated[
    float | None,
    typer.Option(
        metavar="MM", help="Side of a voxel of compounding, mm.", show_default="0.5, or what fits into memory"
    ),
]


class Method(str, enum.Enum):
    """One of ultragray.evaluation.baselines.BASELINES, or all of them."""

    ALL = "all"
    MEDIAN = "median"
    MEAN = "mean"
    MAXIMUM = "maximum"
    LINEAR = "linear"
    NEAREST = "nearest"


@command_app.command(epilog=examples("ultragray compare sweep/", "ultragray compare sweep/ --method median --json"))
@with_options
def compare(
    sweep: SweepArgument,
    json: Json = False,
    method: Annotated[
        Method,
        typer.Option(help="Compounding by voxel, linear between enclosing frames, or the nearest frame as it is."),
    ] = Method.ALL,
    voxel_mm: VoxelMm = None,
    *,
    source: SourceOptions,
) -> None:
    """The figures are those of `ultragray eval`: what a scene must beat to be worth its training."""
    check_source(sweep)

    from ultragray.evaluation.baselines import BASELINES, evaluate_baselines
    from ultragray.evaluation.compounding import affordable_voxel_mm

    read = read_dataset(sweep, source)
    voxel_mm = affordable_voxel_mm(read.train) if voxel_mm is None else voxel_mm
    methods = BASELINES if method is Method.ALL else (method.value,)
    with working(f"measuring {', '.join(methods)} on {len(read.val)} frames …"):
        evaluations = evaluate_baselines(read, methods, voxel_mm)
    if json:
        found = {name: evaluation.to_dict() for name, evaluation in evaluations.items()}
        typer.echo(to_json({"dataset": read.name, "voxel_mm": voxel_mm, "methods": found}))
    else:
        print_metrics(f"{read.name}, {len(read.val)} val frames, voxels of {voxel_mm:g} mm", evaluations)
        print_speckle(evaluations)

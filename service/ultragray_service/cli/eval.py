"""`ultragray eval | compound`: what a scene, or classical compounding, reaches on frames that were held out."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import astuple
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ultragray.datasets.source import SourceOptions

from .dataset import DatasetArgument, check_scene_fits, read_dataset
from .options import with_options
from .output import check_picture_folder

if TYPE_CHECKING:
    from ultragray.datasets.sweep import Sweep
    from ultragray.evaluation.reliability import Reliability
    from ultragray.evaluation.scoring import Evaluation
    from ultragray.scene import GaussianScene


VoxelMm = Annotated[
    float | None,
    typer.Option(metavar="MM", help="Side of a voxel of compounding.", show_default="0.5, or what fits into memory"),
]


class Split(str, enum.Enum):
    """The frames of a dataset to measure on."""

    VAL = "val"
    TRAIN = "train"


class Method(str, enum.Enum):
    """One of ultragray.evaluation.baselines.BASELINES, or all of them."""

    ALL = "all"
    MEDIAN = "median"
    MEAN = "mean"
    MAXIMUM = "maximum"
    LINEAR = "linear"
    NEAREST = "nearest"


@with_options
def evaluate(
    scene: Annotated[Path, typer.Argument(help="Scene file (.ugr).", show_default=False)],
    dataset: DatasetArgument,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="New folder for one picture a frame: truth, rendering, difference, echo, transmittance; and one plot "
            "of the uncertainty, one of the corrected poses.",
            show_default="no pictures",
        ),
    ] = None,
    split: Annotated[Split, typer.Option(help="Frames to measure on.")] = Split.VAL,
    json: Annotated[bool, typer.Option("--json", help="One JSON object, with every frame.")] = False,
    backend: Annotated[str, typer.Option(help="auto, cpu, cuda or reference.")] = "auto",
    register: Annotated[
        bool, typer.Option("--register", help="Also move each frame by one half of it, and score the other half.")
    ] = False,
    *,
    source: SourceOptions,
) -> None:
    """Measure a scene on the held-out frames of a dataset: PSNR, MS-SSIM, GMS, GMSD, speckle, uncertainty."""
    from ultragray.evaluation.reliability import measure_reliability
    from ultragray.evaluation.scoring import evaluate as evaluate_scene
    from ultragray.evaluation.scoring import require_frames
    from ultragray.scene import GaussianScene
    from ultragray_workers.pool.process.placement import render_device

    if output is not None:
        check_picture_folder(output)
    loaded = GaussianScene.load(scene).to(render_device(backend))
    read = read_dataset(dataset, source)
    sweep = read.val if split is Split.VAL else read.train
    require_frames(sweep)
    check_scene_fits(loaded.info, read)
    evaluation = evaluate_scene(loaded, sweep, backend=backend)
    reliability = measure_reliability(loaded, sweep, backend=backend)
    poses = _pose_figures(loaded, sweep if register else None, backend)
    if json:
        figures = evaluation.to_dict() | {"uncertainty": None if reliability is None else reliability.to_dict()}
        figures |= {name: value.to_dict() for name, value in poses.items()}
        _print_json({"scene": str(scene), "dataset": read.name, "split": split.value, **figures})
    else:
        print_metrics(f"{read.name}, {len(sweep)} {split.value} frames", {scene.stem: evaluation})
        print_speckle({scene.stem: evaluation})
        if reliability is not None:
            typer.echo(_in_words(reliability))
        for value in poses.values():
            typer.echo(str(value))
    if output is not None:
        from ultragray.evaluation.side_by_side import write_side_by_side
        from ultragray.files.atomic import write_whole
        from ultragray.report.plots import plot_reliability

        paths = write_side_by_side(loaded, sweep, evaluation.frames, output, backend=backend)
        if reliability is not None:
            paths.append(output / "uncertainty.svg")
            write_whole(paths[-1], plot_reliability(reliability))
        if (corrections := poses.get("pose_corrections")) is not None:
            paths.append(output / "pose_corrections.svg")
            corrections.write_plot(paths[-1])
        typer.echo(f"wrote {len(paths)} pictures into {output}", err=json)


def _pose_figures(scene: GaussianScene, registered: Sweep | None, backend: str) -> dict[str, Any]:
    """How far a scene's training poses were corrected, and the scores of registered frames, by their key in JSON."""
    from ultragray.training.poses.held_out import score_halves
    from ultragray.training.poses.sizes import CorrectionSizes

    found: dict[str, Any] = {}
    if scene.pose_corrections is not None:
        found["pose_corrections"] = CorrectionSizes.of(scene.pose_corrections, scene.training_poses)
    if registered is not None:
        found["halves"] = score_halves(scene, registered, backend=backend)
    return found


@with_options
def compound(
    dataset: DatasetArgument,
    method: Annotated[
        Method,
        typer.Option(help="Compounding by voxel, linear between enclosing frames, or the nearest frame as it is."),
    ] = Method.ALL,
    voxel_mm: VoxelMm = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON object, with every frame.")] = False,
    *,
    source: SourceOptions,
) -> None:
    """Measure classical compounding of the training frames on the held-out ones, as eval measures a scene."""
    from ultragray.evaluation.baselines import BASELINES, evaluate_baselines
    from ultragray.evaluation.compounding import affordable_voxel_mm

    read = read_dataset(dataset, source)
    voxel_mm = affordable_voxel_mm(read.train) if voxel_mm is None else voxel_mm
    methods = BASELINES if method is Method.ALL else (method.value,)
    evaluations = evaluate_baselines(read, methods, voxel_mm)
    if json:
        found = {name: evaluation.to_dict() for name, evaluation in evaluations.items()}
        _print_json({"dataset": read.name, "voxel_mm": voxel_mm, "methods": found})
    else:
        print_metrics(f"{read.name}, {len(read.val)} val frames, voxels of {voxel_mm:g} mm", evaluations)
        print_speckle(evaluations)


def print_metrics(title: str, evaluations: Mapping[str, Evaluation]) -> None:
    """A table of mean ± standard deviation over the frames, one row a name."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for place, head in enumerate(("", "PSNR, dB", "MS-SSIM", "GMS", "GMSD")):
        table.add_column(head, justify="right" if place else "left", no_wrap=True)
    for name, evaluation in evaluations.items():
        mean, std = evaluation.mean, evaluation.std
        table.add_row(
            name,
            f"{mean.psnr_db:.2f} ± {std.psnr_db:.2f}",
            *(f"{getattr(mean, key):.3f} ± {getattr(std, key):.3f}" for key in ("ms_ssim", "gms", "gmsd")),
        )
    console = Console()
    console.print(title, highlight=False, markup=False, soft_wrap=True)
    console.print(table)
    scales = next(iter(evaluations.values())).ms_ssim_scales
    if scales < 5:
        console.print(f"MS-SSIM over {scales} of its 5 scales, which is what the image holds", style="dim")


def print_speckle(evaluations: Mapping[str, Evaluation]) -> None:
    """A table of the statistics of speckle, means over the frames: the true frames, then one row a name."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for place, head in enumerate(("speckle", "contrast", "axial, mm", "lateral, mm", "histogram distance")):
        table.add_column(head, justify="right" if place else "left", no_wrap=True)
    summaries = {name: evaluation.speckle for name, evaluation in evaluations.items()}
    true = next(iter(summaries.values())).true
    rows = {
        "true frames": (true, ""),
        **{n: (one.rendered, f"{one.histogram_distance:.4f}") for n, one in summaries.items()},
    }
    for name, (speckle, distance) in rows.items():
        figures = ("–",) * 3 if speckle is None else [f"{value:.3f}" for value in astuple(speckle)]
        table.add_row(name, *figures, distance)
    Console().print(table)


def _in_words(reliability: Reliability) -> str:
    return (
        f"uncertainty: pixels are off by {reliability.expected:.3f} as expected, {reliability.actual:.3f} in truth; "
        f"{reliability.within_1:.0%} of the errors are within 1, {reliability.within_2:.0%} within 2 deviations"
    )


def _print_json(document: Mapping[str, Any]) -> None:
    from json import dumps

    typer.echo(dumps(document, indent=2, allow_nan=False))

"""`ultragray eval`: what a scene reaches on frames that were held out, as tables."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import astuple
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ultragray.datasets.source import SourceOptions
from ultragray.errors import InvalidArgument
from ultragray.scene.info import read_header
from ultragray_service.cli.options import with_options
from ultragray_service.cli.sweeps import SweepArgument, check_scene_fits, check_source, read_dataset
from ultragray_service.cli.terminal import (
    Backend,
    Force,
    Json,
    SceneFile,
    check_folder,
    option,
    output_option,
    single,
    to_json,
    wide_console,
    working,
)

if TYPE_CHECKING:
    from rich.table import Table

    from ultragray.learn.evaluation.scoring import Evaluation, Reliability


class Split(str, enum.Enum):
    VAL = "val"
    TRAIN = "train"


@single(
    "ultragray eval liver.ugr sweep/",
    "ultragray eval liver.ugr sweep/ -o pictures/  # truth beside rendering, frame by frame",
    "ultragray eval liver.ugr sweep/ --json | jq .mean",
    name="eval",
)
@with_options
def evaluate(
    scene: SceneFile,
    sweep: SweepArgument,
    output: Annotated[
        Path | None,
        output_option(
            "New folder for one picture a frame: truth, rendering, difference, echo, transmittance; and one plot "
            "of the uncertainty, one of the corrected poses.",
            default="no pictures",
        ),
    ] = None,
    force: Force = False,
    json: Json = False,
    split: Annotated[Split, option("Frames to measure on.")] = Split.VAL,
    register: Annotated[
        bool, option("Also move each held-out frame by one half of it, and score the other half.", "--register")
    ] = False,
    backend: Backend = "auto",
    *,
    source: SourceOptions,
) -> None:
    """The figures: PSNR, MS-SSIM, GMS, GMSD, speckle statistics, and how well the scene knows its own errors.

    Held-out frames are scored as given, and on the path that the scene was trained on.
    """
    if register and split is Split.TRAIN:
        raise InvalidArgument("--register is for held-out frames: leave out --split train", field="register")
    if output is not None:
        check_folder(output, force=force)
    read_header(scene)
    check_source(sweep)

    from ultragray.learn.evaluation.held_out import score_held_out
    from ultragray.learn.evaluation.scoring import evaluate as evaluate_scene
    from ultragray.learn.evaluation.scoring import measure_reliability, require_frames
    from ultragray.learn.report.sizes import CorrectionSizes
    from ultragray.rendering.backends.registry import render_device
    from ultragray.scene.gaussians import GaussianScene

    loaded = GaussianScene.load(scene).to(render_device(backend))
    dataset = read_dataset(sweep, source)
    frames = dataset.val if split is Split.VAL else dataset.train
    require_frames(frames)
    check_scene_fits(loaded.info, dataset)
    with working(f"measuring {len(frames)} frames …"):
        evaluation = evaluate_scene(loaded, frames, backend=backend)
        reliability = measure_reliability(loaded, frames, backend=backend)
        sizes = CorrectionSizes.of(loaded)
        held_out = None
        if split is Split.VAL:
            held_out = score_held_out(loaded, dataset, evaluation, register=register, backend=backend)
    if json:
        figures = evaluation.to_dict() | {"uncertainty": None if reliability is None else reliability.to_dict()}
        figures |= {} if sizes is None else {"pose_corrections": sizes.to_dict()}
        figures |= {} if held_out is None else {"held_out": held_out.to_dict()}
        typer.echo(to_json({"scene": str(scene), "dataset": dataset.name, "split": split.value, **figures}))
    else:
        rows = {} if held_out is None else {f"{scene.stem}, {name}": one for name, one in held_out.rows.items()}
        table = rows if len(rows) > 1 else {scene.stem: evaluation}
        print_metrics(f"{dataset.name}, {len(frames)} {split.value} frames", table)
        print_speckle({scene.stem: evaluation})
        if reliability is not None:
            typer.echo(_in_words(reliability))
        if sizes is not None:
            typer.echo(str(sizes))
    if output is not None:
        from ultragray.files import write_whole
        from ultragray.learn.evaluation.side_by_side import write_side_by_side
        from ultragray.learn.report.plots import plot_corrections, plot_reliability

        with working(f"drawing {len(frames)} pictures …"):
            paths = write_side_by_side(loaded, frames, evaluation.frames, output, backend=backend)
        if reliability is not None:
            paths.append(output / "uncertainty.svg")
            write_whole(paths[-1], plot_reliability(reliability))
        if sizes is not None:
            paths.append(output / "pose_corrections.svg")
            write_whole(paths[-1], plot_corrections(sizes.shift_mm, sizes.turn_deg))
        typer.echo(f"wrote {len(paths)} pictures into {output}", err=json)


def _in_words(reliability: Reliability) -> str:
    return (
        f"uncertainty: pixels are off by {reliability.expected:.3f} as expected, {reliability.actual:.3f} in truth; "
        f"{reliability.within_1:.0%} of the errors are within 1, {reliability.within_2:.0%} within 2 deviations"
    )


def _table(*heads: str) -> Table:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for place, head in enumerate(heads):
        table.add_column(head, justify="right" if place else "left", no_wrap=True)
    return table


def print_metrics(title: str, evaluations: Mapping[str, Evaluation]) -> None:
    from rich.console import Console
    from rich.markup import escape

    table = _table("", "PSNR, dB", "MS-SSIM", "GMS", "GMSD")
    for name, evaluation in evaluations.items():
        mean, std = evaluation.mean, evaluation.std
        table.add_row(
            escape(name),
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
    from rich.markup import escape

    from ultragray.learn.report.tables import SPECKLE_COLUMNS, speckle_summaries

    table = _table("speckle", *SPECKLE_COLUMNS, "histogram distance")
    summaries = speckle_summaries(evaluations)
    true = next(iter(summaries.values())).true
    rows = {
        "true frames": (true, ""),
        **{n: (one.rendered, f"{one.histogram_distance:.4f}") for n, one in summaries.items()},
    }
    for name, (speckle, distance) in rows.items():
        figures = ("–",) * len(SPECKLE_COLUMNS) if speckle is None else [f"{value:.3f}" for value in astuple(speckle)]
        table.add_row(escape(name), *figures, distance)
    wide_console().print(table)

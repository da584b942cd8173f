"""`ultragray eval`: what a scene reaches on frames that were held out."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ultragray.datasets.source import SourceOptions
from ultragray.scene_info import read_header
from ultragray_service.cli.options import with_options
from ultragray_service.cli.output import check_folder
from ultragray_service.cli.progress import working
from ultragray_service.cli.studies.tables import print_metrics, print_speckle
from ultragray_service.cli.style import Backend, Force, Json, SceneFile, command_group, examples, output_option, to_json
from ultragray_service.cli.sweeps.source import SweepArgument, check_scene_fits, check_source, read_dataset

if TYPE_CHECKING:
    from ultragray.learn.evaluation.scoring import Reliability
    from ultragray.learn.sweep import Sweep
    from ultragray.scene import GaussianScene

command_app = command_group()


class Split(str, enum.Enum):
    """The frames of a dataset to measure on."""

    VAL = "val"
    TRAIN = "train"


@command_app.command(
    "eval",
    epilog=examples(
        "ultragray eval liver.ugr sweep/",
        "ultragray eval liver.ugr sweep/ -o pictures/  # truth beside rendering, frame by frame",
        "ultragray eval liver.ugr sweep/ --json | jq .mean",
    ),
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
    split: Annotated[Split, typer.Option(help="Frames to measure on.")] = Split.VAL,
    register: Annotated[
        bool, typer.Option("--register", help="Also move each frame by one half of it, and score the other half.")
    ] = False,
    backend: Backend = "auto",
    *,
    source: SourceOptions,
) -> None:
    """The figures: PSNR, MS-SSIM, GMS, GMSD, speckle statistics, and how well the scene knows its own errors."""
    if output is not None:
        check_folder(output, force=force)
    read_header(scene)
    check_source(sweep)

    from ultragray.learn.evaluation.scoring import evaluate as evaluate_scene
    from ultragray.learn.evaluation.scoring import measure_reliability, require_frames
    from ultragray.scene import GaussianScene
    from ultragray_workers.pool.process.placement import render_device

    loaded = GaussianScene.load(scene).to(render_device(backend))
    read = read_dataset(sweep, source)
    frames = read.val if split is Split.VAL else read.train
    require_frames(frames)
    check_scene_fits(loaded.info, read)
    with working(f"measuring {len(frames)} frames …"):
        evaluation = evaluate_scene(loaded, frames, backend=backend)
        reliability = measure_reliability(loaded, frames, backend=backend)
        poses = _pose_figures(loaded, frames if register else None, backend)
    if json:
        figures = evaluation.to_dict() | {"uncertainty": None if reliability is None else reliability.to_dict()}
        figures |= {name: value.to_dict() for name, value in poses.items()}
        typer.echo(to_json({"scene": str(scene), "dataset": read.name, "split": split.value, **figures}))
    else:
        print_metrics(f"{read.name}, {len(frames)} {split.value} frames", {scene.stem: evaluation})
        print_speckle({scene.stem: evaluation})
        if reliability is not None:
            typer.echo(_in_words(reliability))
        for value in poses.values():
            typer.echo(str(value))
    if output is not None:
        from ultragray.files.atomic import write_whole
        from ultragray.learn.evaluation.side_by_side import write_side_by_side
        from ultragray.learn.report.plots import plot_corrections, plot_reliability

        with working(f"drawing {len(frames)} pictures …"):
            paths = write_side_by_side(loaded, frames, evaluation.frames, output, backend=backend)
        if reliability is not None:
            paths.append(output / "uncertainty.svg")
            write_whole(paths[-1], plot_reliability(reliability))
        if (corrections := poses.get("pose_corrections")) is not None:
            paths.append(output / "pose_corrections.svg")
            write_whole(paths[-1], plot_corrections(corrections.shift_mm, corrections.turn_deg))
        typer.echo(f"wrote {len(paths)} pictures into {output}", err=json)


def _pose_figures(scene: GaussianScene, registered: Sweep | None, backend: str) -> dict[str, Any]:
    """How far a scene's training poses were corrected, and the scores of registered frames, by their key in JSON."""
    from ultragray.learn.report.sizes import CorrectionSizes
    from ultragray.learn.training.poses import score_halves

    found: dict[str, Any] = {}
    if scene.pose_corrections is not None:
        found["pose_corrections"] = CorrectionSizes.of(scene.pose_corrections, scene.training_poses)
    if registered is not None:
        found["halves"] = score_halves(scene, registered, backend=backend)
    return found


def _in_words(reliability: Reliability) -> str:
    return (
        f"uncertainty: pixels are off by {reliability.expected:.3f} as expected, {reliability.actual:.3f} in truth; "
        f"{reliability.within_1:.0%} of the errors are within 1, {reliability.within_2:.0%} within 2 deviations"
    )

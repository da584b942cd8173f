"""`ultragray plan`: where to look next."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ultragray.exchange.poses import load_poses
from ultragray.files import npy_bytes, write_whole
from ultragray.learn.planning.settings import PlanSettings, ViewPlan
from ultragray.scene.info import read_header
from ultragray_service.cli.options import with_options
from ultragray_service.cli.register import POSE_SUFFIXES
from ultragray_service.cli.terminal import (
    Force,
    Json,
    SceneFile,
    check_file,
    option,
    output_option,
    single,
    tell,
    working,
)

if TYPE_CHECKING:
    from ultragray.geometry.probe import FloatArray


@single(
    "ultragray plan liver.ugr --views 50 -o next.npy",
    "ultragray plan liver.ugr --want confidence --path-mm 300 --start here.npy --box-mm=-40:40,0:80,-5:20",
)
@with_options
def plan(
    scene: SceneFile,
    settings: PlanSettings,
    poses: Annotated[
        Path | None,
        option("All that is in reach: .npy, .json, .mcap.", shown="the skin under the training views"),
    ] = None,
    view: Annotated[Path | None, option("A standard plane: only points of its image count.", shown=False)] = None,
    start: Annotated[Path | None, option("Where the probe is.", shown="the way begins anywhere")] = None,
    output: Annotated[Path | None, output_option("The poses as .npy, [K, 4, 4].", default="not written")] = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Poses in reach whose frames would teach the scene most, in an order to travel them, each with what it is
    expected to gain. Exit status 1: none gains anything."""
    if output is not None:
        check_file(output, POSE_SUFFIXES, force=force)
    read_header(scene)
    reach, standard, begin = (None if one is None else load_poses(one) for one in (poses, view, start))

    from ultragray import GaussianScene, plan_views

    with working("planning …"):
        view_plan = plan_views(GaussianScene.load(scene), settings, poses=reach, view=standard, start=begin)
    if output is not None and len(view_plan.poses):
        write_whole(output, npy_bytes(view_plan.poses))
    tell(_in_words(view_plan, settings), {name: _plain(one) for name, one in asdict(view_plan).items()}, as_json=json)
    if not len(view_plan.poses):
        raise typer.Exit(1)


def _plain(value: FloatArray | float) -> object:
    return value if isinstance(value, float) else value.tolist()


def _in_words(outcome: ViewPlan, settings: PlanSettings) -> str:
    if not len(outcome.poses):
        way = "" if settings.path_mm is None else f" on a way of {settings.path_mm:g} mm"
        return f"no pose in reach{way} adds to the {settings.want} of {outcome.before:.3f}"
    rows = [
        f"{'  '.join(f'{value:8.2f}' for value in pose[:3, 3])}   {gain:+.4f}"
        for pose, gain in zip(outcome.poses, outcome.gains, strict=True)
    ]
    head = f"{len(rows)} views, {outcome.path_mm:.0f} mm: {settings.want} {outcome.before:.3f} → {outcome.after:.3f}"
    return "\n".join([head, "       x         y         z mm   gain", *rows])

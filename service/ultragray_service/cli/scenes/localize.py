"""`ultragray localize`: where in a scene a real frame was taken."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ultragray.errors import InvalidArgument
from ultragray.files.poses import load_poses
from ultragray.learn.localization.pixels import read_frame
from ultragray.scene_info import read_header
from ultragray_service.cli.output import check_file
from ultragray_service.cli.progress import working
from ultragray_service.cli.style import Backend, Force, Json, SceneFile, command_group, examples, output_option, tell

if TYPE_CHECKING:
    from ultragray import Localization

POSE_SUFFIXES = (".npy",)
command_app = command_group()


@command_app.command(
    epilog=examples(
        "ultragray localize liver.ugr frame.png --start pose.npy",
        "ultragray localize liver.ugr frame.npy --start pose.json --within-mm 10 -o found.npy",
    )
)
def localize(
    scene: SceneFile,
    image: Annotated[
        Path,
        typer.Argument(
            help="The frame, .png or .npy: rows along depth, columns across scan lines, not scan-converted.",
            show_default=False,
        ),
    ],
    start: Annotated[
        Path,
        typer.Option(help="A pose that is about right: .npy or .json, 4x4 or 3x4, in mm; .mcap.", show_default=False),
    ],
    within_mm: Annotated[float, typer.Option(help="How far the start may be off.")] = 3.0,
    within_deg: Annotated[float, typer.Option(help="By which angle.")] = 5.0,
    output: Annotated[Path | None, output_option("The pose as .npy, [4, 4].", default="not written")] = None,
    force: Force = False,
    json: Json = False,
    backend: Backend = "auto",
) -> None:
    """The probe is the one that the scene was trained with. Exit status 1: the frame was not found."""
    if output is not None:
        check_file(output, POSE_SUFFIXES, force=force)
    read_header(scene)
    poses = load_poses(start)
    if len(poses) != 1:
        raise InvalidArgument(f"{start} must hold one pose, got {len(poses)}", field="start")
    pixels = read_frame(image)

    from ultragray import GaussianScene
    from ultragray import localize as search

    with working("looking for the frame …"):
        loaded = GaussianScene.load(scene)
        found = search(loaded, pixels, poses[0], within_mm=within_mm, within_deg=within_deg, backend=backend)
    if output is not None and found.is_found:
        _write_pose(output, found)
    document = asdict(found) | {"pose": found.pose.tolist()}
    tell(_in_words(found, output), document, as_json=json)
    if not found.is_found:
        raise typer.Exit(1)


def _write_pose(path: Path, found: Localization) -> None:
    import io

    import numpy as np

    from ultragray.files.atomic import write_whole

    data = io.BytesIO()
    np.save(data, found.pose)
    write_whole(path, data.getvalue())


def _in_words(found: Localization, output: Path | None) -> str:
    from ultragray.learn.localization.search import FOUND_SIMILARITY

    if not found.is_found:
        return (
            f"not found: the place that looks most like it has a similarity of {found.similarity:.2f}, where "
            f"{FOUND_SIMILARITY} is needed; a start that is closer, or a larger --within-mm, may help"
        )
    position = ", ".join(f"{one:.2g}" for one in found.position_std_mm)
    angle = ", ".join(f"{one:.2g}" for one in found.angle_std_deg)
    rows = "\n".join("  " + "  ".join(f"{value:10.4f}" for value in row) for row in found.pose)
    where = "" if output is None else f"\nwrote {output}"
    return (
        f"found with a similarity of {found.similarity:.2f}, {found.shift_mm:.2f} mm and {found.turn_deg:.2f}° from "
        f"the start; standard deviations along and about the probe's axes: {position} mm, {angle}°\n{rows}{where}"
    )

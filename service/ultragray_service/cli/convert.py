"""`ultragray export`, `import-ply` and `import-checkpoint`: scenes for other programs, and back."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ultragray.errors import InvalidArgument

from .output import SCENE_SUFFIX, check_writable

if TYPE_CHECKING:
    from ultragray import GaussianScene


def export(
    scene: Annotated[Path, typer.Argument(help="Scene file (.ugr).", show_default=False)],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help="A .ply file, which holds everything, or a .pt checkpoint of the released code, which gets conf.json "
            "and poses_train.npy beside it: give it a folder of its own.",
            show_default=False,
        ),
    ],
) -> None:
    """Write a scene as PLY or as a checkpoint of the released UltraG-Ray code."""
    if output.suffix not in (".ply", ".pt"):
        raise InvalidArgument(f"output must end in .ply or .pt, got {output.name!r}", field="output")
    folder = output.absolute().parent
    check_writable(output if folder.exists() or output.suffix == ".ply" else folder)

    from ultragray import GaussianScene

    loaded = GaussianScene.load(scene)
    (_export_ply if output.suffix == ".ply" else _export_checkpoint)(loaded, output)


def _export_ply(scene: GaussianScene, output: Path) -> None:
    from ultragray.interchange.ply import write_ply

    write_ply(scene, output)
    typer.echo(f"wrote {output}: {scene.gaussian_count:,} Gaussians, {len(scene.training_poses)} training poses")


def _export_checkpoint(scene: GaussianScene, output: Path) -> None:
    from ultragray.interchange.checkpoint_export import export_checkpoint

    written = export_checkpoint(scene, output)
    x, y, z = written.centre_mm
    names = ", ".join(map(str, written.files))
    typer.echo(f"wrote {names}: {scene.gaussian_count:,} Gaussians about ({x:.2f}, {y:.2f}, {z:.2f}) mm")
    for note in written.notes:
        typer.secho(f"note: {note}", fg=typer.colors.YELLOW, err=True)


def import_ply(
    file: Annotated[Path, typer.Argument(help="PLY file that `ultragray export` wrote.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", help="Scene file to write (.ugr).", show_default=False)],
) -> None:
    """Turn a PLY file of a scene back into a scene file."""
    check_writable(output, SCENE_SUFFIX)

    from ultragray.interchange.ply import read_ply

    scene = read_ply(file)
    scene.save(output)
    typer.echo(f"wrote {output}: {scene.gaussian_count:,} Gaussians, {len(scene.training_poses)} training poses")


def import_checkpoint(
    checkpoint: Annotated[Path, typer.Argument(help="Checkpoint of the released trainer (.pt).", show_default=False)],
    config: Annotated[Path, typer.Option(help="conf.json of its dataset.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", help="Scene file to write (.ugr).", show_default=False)],
    poses: Annotated[
        Path | None,
        typer.Option(help="Its training poses (poses_train.npy); they give the centre.", show_default=False),
    ] = None,
    center: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y Z", help="Instead of --poses: the scene centre in mm.", show_default=False),
    ] = None,
    centered: Annotated[
        bool, typer.Option("--centered", help="Instead of --poses: poses will be relative to the centre.")
    ] = False,
    image_height: Annotated[
        int | None,
        typer.Option(help="Height of the training images.", show_default="from the images file that conf.json names"),
    ] = None,
) -> None:
    """Turn a released UltraG-Ray checkpoint into a scene file, with its place in the tracker's frame."""
    from ultragray.interchange.checkpoint import import_checkpoint as read_checkpoint

    if [poses is not None, center is not None, centered].count(True) != 1:
        raise InvalidArgument(
            "give exactly one of --poses (its training poses), --center X Y Z (the scene centre in mm) and "
            "--centered (poses relative to the centre)",
            field="poses",
        )
    check_writable(output, SCENE_SUFFIX)
    try:
        scene = read_checkpoint(
            checkpoint,
            config=config,
            poses=poses,
            center_mm=center,
            centered=centered,
            image_height=image_height,
        )
    except InvalidArgument as error:
        option = "--image-height: " if error.field == "image_height" else ""
        raise InvalidArgument(f"{option}{error.detail}", field=error.field) from error
    scene.save(output)
    x, y, z = scene.info.centre_mm
    typer.echo(
        f"wrote {output}: {scene.gaussian_count:,} Gaussians about ({x:.2f}, {y:.2f}, {z:.2f}) mm, {scene.info.probe}"
    )

"""`ultragray export` and `ultragray import-ply`: scenes for other programs, and back."""

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

"""`ultragray export`: a scene for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ultragray.scene_info import read_header
from ultragray_service.cli.output import check_ending, check_file
from ultragray_service.cli.style import Force, Json, SceneFile, command_group, examples, output_option, tell

if TYPE_CHECKING:
    from ultragray import GaussianScene

EXCHANGED = (".ply", ".pt")
command_app = command_group()


@command_app.command(
    epilog=examples(
        "ultragray export liver.ugr -o liver.ply",
        "ultragray export liver.ugr -o released/ckpt.pt  # a folder of its own",
    )
)
def export(
    scene: SceneFile,
    output: Annotated[
        Path,
        output_option(
            "A .ply file, which holds everything, or a .pt checkpoint of the released code, which gets conf.json "
            "and poses_train.npy beside it: give it a folder of its own."
        ),
    ],
    force: Force = False,
    json: Json = False,
) -> None:
    """`ultragray import` turns either file back into a scene file."""
    check_ending(output, EXCHANGED)
    folder = output.absolute().parent
    check_file(output if output.suffix == ".ply" or folder.exists() else folder, force=force)
    read_header(scene)

    from ultragray import GaussianScene

    loaded = GaussianScene.load(scene)
    written = _write_ply(loaded, output) if output.suffix == ".ply" else _write_checkpoint(loaded, output, force)
    for note in written["notes"]:
        typer.secho(f"note: {note}", fg=typer.colors.YELLOW, err=True)
    tell(f"wrote {', '.join(written['files'])}: {written.pop('sentence')}", written, as_json=json)


def _write_ply(scene: GaussianScene, output: Path) -> dict[str, Any]:
    from ultragray.exchange.ply import write_ply

    write_ply(scene, output)
    poses = len(scene.training_poses)
    return {
        "sentence": f"{scene.gaussian_count:,} Gaussians, {poses} training poses",
        "files": [str(output)],
        "gaussian_count": scene.gaussian_count,
        "training_poses": poses,
        "notes": [],
    }


def _write_checkpoint(scene: GaussianScene, output: Path, replace: bool) -> dict[str, Any]:
    from ultragray.exchange.checkpoint import export_checkpoint

    written = export_checkpoint(scene, output, replace=replace)
    x, y, z = written.centre_mm
    return {
        "sentence": f"{scene.gaussian_count:,} Gaussians about ({x:.2f}, {y:.2f}, {z:.2f}) mm",
        "files": [str(path) for path in written.files],
        "gaussian_count": scene.gaussian_count,
        "centre_mm": [float(one) for one in written.centre_mm],
        "notes": list(written.notes),
    }

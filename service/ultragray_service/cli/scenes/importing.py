"""`ultragray import`: a scene file out of what other programs wrote, told apart by the name's ending."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ultragray.errors import InvalidArgument
from ultragray_service.cli.output import SCENE_SUFFIX, check_file
from ultragray_service.cli.scenes.export import EXCHANGED
from ultragray_service.cli.style import Force, Json, command_group, examples, output_option, tell

_CHECKPOINT = "Checkpoint (.pt)"
command_app = command_group()


@command_app.command(
    "import",
    epilog=examples(
        "ultragray import liver.ply -o liver.ugr",
        "ultragray import ckpt.pt --config conf.json --poses poses_train.npy -o liver.ugr",
    ),
)
def import_scene(
    file: Annotated[
        Path,
        typer.Argument(
            help="A .ply file that `ultragray export` wrote, or a .pt checkpoint of the released trainer.",
            show_default=False,
        ),
    ],
    output: Annotated[Path, output_option("Scene file to write (.ugr).")],
    force: Force = False,
    json: Json = False,
    config: Annotated[
        Path | None, typer.Option(help="conf.json of its dataset.", show_default=False, rich_help_panel=_CHECKPOINT)
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="Its training poses (poses_train.npy); they give the centre.",
            show_default=False,
            rich_help_panel=_CHECKPOINT,
        ),
    ] = None,
    center: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar="X Y Z",
            help="Instead of --poses: the scene centre in mm.",
            show_default=False,
            rich_help_panel=_CHECKPOINT,
        ),
    ] = None,
    centered: Annotated[
        bool,
        typer.Option(
            "--centered",
            help="Instead of --poses: poses will be relative to the centre.",
            rich_help_panel=_CHECKPOINT,
        ),
    ] = False,
    image_height: Annotated[
        int | None,
        typer.Option(
            help="Height of the training images.",
            show_default="from the images file that conf.json names",
            rich_help_panel=_CHECKPOINT,
        ),
    ] = None,
) -> None:
    """A checkpoint gets its place in the tracker's frame from the poses that it was trained with."""
    if file.suffix not in EXCHANGED:
        raise InvalidArgument(
            f"import reads {' and '.join(EXCHANGED)} files, got {str(file)!r}; a scene file needs no import",
            field="file",
        )
    if not file.is_file():
        raise InvalidArgument(f"{file}: no such file", field="file")
    of_checkpoint = {
        "--config": config is not None,
        "--poses": poses is not None,
        "--center": center is not None,
        "--centered": centered,
        "--image-height": image_height is not None,
    }
    if file.suffix == ".ply":
        if given := [name for name, is_given in of_checkpoint.items() if is_given]:
            raise InvalidArgument(f"{given[0]} is for checkpoints (.pt), {file.name} is a PLY file", field="file")
    elif config is None:
        raise InvalidArgument("--config must be given: the conf.json of the checkpoint's dataset", field="config")
    elif [poses is not None, center is not None, centered].count(True) != 1:
        raise InvalidArgument(
            "give exactly one of --poses (its training poses), --center X Y Z (the scene centre in mm) and "
            "--centered (poses relative to the centre)",
            field="poses",
        )
    check_file(output, [SCENE_SUFFIX], force=force)

    if config is None:
        from ultragray.exchange.ply import read_ply

        scene = read_ply(file)
        place = f"{len(scene.training_poses)} training poses"
    else:
        from ultragray.exchange.checkpoint import import_checkpoint

        try:
            scene = import_checkpoint(
                file, config=config, poses=poses, center_mm=center, centered=centered, image_height=image_height
            )
        except InvalidArgument as error:
            option = "--image-height: " if error.field == "image_height" else ""
            raise InvalidArgument(f"{option}{error.detail}", field=error.field) from error
        x, y, z = scene.info.centre_mm
        place = f"centre ({x:.2f}, {y:.2f}, {z:.2f}) mm, {scene.info.probe}"
    scene.save(output)
    document = {
        "output": str(output),
        "gaussian_count": scene.gaussian_count,
        "training_poses": len(scene.training_poses),
        "centre_mm": list(scene.info.centre_mm),
    }
    tell(f"wrote {output}: {scene.gaussian_count:,} Gaussians, {place}", document, as_json=json)

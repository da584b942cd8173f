"""`ultragray voxelize`: a scene's fields as a volume, or as a slice."""

from __future__ import annotations

from collections.abc import Sequence
from operator import gt, lt
from pathlib import Path
from typing import Annotated

import typer

from ultragray.errors import InvalidArgument
from ultragray.scene_info import SceneInfo, read_header
from ultragray.volumes.names import SLICE_SUFFIXES, VOLUME_FIELDS, VOLUME_SUFFIXES
from ultragray_service.cli.output import check_file
from ultragray_service.cli.progress import working
from ultragray_service.cli.style import Force, Json, SceneFile, command_group, examples, output_option, tell, warn

RIGHT, DOWN = "1,0,0", "0,0,1"
command_app = command_group()


@command_app.command(
    epilog=examples(
        "ultragray voxelize liver.ugr -o liver.nii.gz --spacing-mm 0.5",
        "ultragray voxelize liver.ugr -o bone.nrrd --field attenuation --box-mm=-20:20,-30:30,0:60",
        "ultragray voxelize liver.ugr -o cut.png --plane-mm=-20,0,0 --right 1,0,0 --down 0,0,1 --size-mm 40,60",
    )
)
def voxelize(
    scene: SceneFile,
    output: Annotated[
        Path,
        output_option(
            "A volume: .nii.gz, .nii or .nrrd. A slice (--plane-mm): .png, .npy, or a volume of one layer of voxels."
        ),
    ],
    field: Annotated[str, typer.Option(help=f"One of: {', '.join(VOLUME_FIELDS)}; attenuation is per mm.")] = "echo",
    spacing_mm: Annotated[float, typer.Option(help="Distance of two voxels along each axis.")] = 0.5,
    box_mm: Annotated[
        str | None,
        typer.Option(
            help="Ranges of x, y and z in the scene's frame, such as -20:20,0:30,-5:45. Default: the bounds of "
            "the Gaussians.",
            show_default=False,
        ),
    ] = None,
    plane_mm: Annotated[
        str | None, typer.Option(help="Corner x,y,z of a slice, instead of a volume.", show_default=False)
    ] = None,
    right: Annotated[str, typer.Option(help="Direction of the rows of the slice.")] = RIGHT,
    down: Annotated[str, typer.Option(help="Direction of its columns.")] = DOWN,
    size_mm: Annotated[str | None, typer.Option(help="Its width,height.", show_default=False)] = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """The scene without a probe, in its own frame, sampled on a regular grid."""
    if plane_mm is None and output.name.endswith(SLICE_SUFFIXES):
        raise InvalidArgument(
            f"output {output.name!r} is for a slice: give plane_mm and size_mm, or a volume a name that ends in "
            f"{', '.join(VOLUME_SUFFIXES)}",
            field="output",
        )
    if plane_mm is None and (right, down) != (RIGHT, DOWN):
        raise InvalidArgument("right and down are for a slice: give plane_mm, too", field="plane_mm")
    check_file(output, VOLUME_SUFFIXES if plane_mm is None else (*SLICE_SUFFIXES, *VOLUME_SUFFIXES), force=force)
    info = read_header(scene).info

    from ultragray import GaussianScene
    from ultragray.volumes.files import volume_facts, write_slice, write_volume
    from ultragray.volumes.grid import VolumeGrid, parse_box, parse_numbers

    if plane_mm is None:
        if size_mm is not None:
            raise InvalidArgument("size_mm is for a slice: give plane_mm, too", field="size_mm")
        grid = VolumeGrid.over_scene(info, box_mm, spacing_mm)
        if box_mm is not None and _is_beyond(info, *parse_box(box_mm)):
            there = ",".join(f"{a:g}:{b:g}" for a, b in zip(info.bounds_min_mm, info.bounds_max_mm, strict=True))
            warn(f"box_mm lies beyond all Gaussians, which are in {there}: is it in mm of the scene's frame?")
    else:
        if size_mm is None or box_mm is not None:
            raise InvalidArgument("a slice needs size_mm, its width,height, and takes no box_mm", field="size_mm")
        directions = parse_numbers(right, 3, "right"), parse_numbers(down, 3, "down")
        size = parse_numbers(size_mm, 2, "size_mm")
        grid = VolumeGrid.on_plane(parse_numbers(plane_mm, 3, "plane_mm"), *directions, size, spacing_mm)
    with working(f"sampling {' x '.join(map(str, grid.shape))} points …"):
        loaded = GaussianScene.load(scene)
        (write_slice if output.name.endswith(SLICE_SUFFIXES) else write_volume)(output, loaded, field, grid)
    document = {"file": str(output), **volume_facts(info, field, grid)}
    tell(f"wrote {output}: {field}, {' x '.join(map(str, grid.shape))} at {spacing_mm:g} mm", document, as_json=json)


def _is_beyond(info: SceneInfo, low: Sequence[float], high: Sequence[float]) -> bool:  # [3] mm both
    """Whether a box lies beyond the centres of all Gaussians."""
    return any(map(lt, high, info.bounds_min_mm)) or any(map(gt, low, info.bounds_max_mm))

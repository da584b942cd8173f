"""`ultragray slicer`: a scene file of 3D Slicer, connected to the service that serves a scene."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from ultragray.errors import InvalidArgument
from ultragray.exchange.slicer import SlicerScene
from ultragray.scene_info import read_header
from ultragray_service.cli.output import check_file
from ultragray_service.cli.progress import working
from ultragray_service.cli.style import Force, Json, SceneFile, command_group, examples, output_option, tell
from ultragray_service.igtl.routes import device_of, image_name

command_app = command_group()

SUFFIX, VOLUME_SUFFIX = ".mrml", "-echo.nii.gz"


@command_app.command(
    epilog=examples(
        "ultragray slicer scenes/liver.ugr -o liver.mrml",
        "ultragray slicer scenes/liver.ugr -o liver.mrml --igtl-address 10.0.0.5:18944",
    )
)
def slicer(
    scene: SceneFile,
    output: Annotated[Path, output_option(f"{SUFFIX}; the volume NAME{VOLUME_SUFFIX} is written beside it.")],
    igtl_address: Annotated[str, typer.Option(help="HOST:PORT of the service's OpenIGTLink.")] = "127.0.0.1:18944",
    spacing_mm: Annotated[float, typer.Option(help="Distance of two voxels of the volume.")] = 1.0,
    force: Force = False,
    json: Json = False,
) -> None:
    """Write a scene file of 3D Slicer: a connector to the service, a pose that it sends, and the scene as a volume."""
    host, port = _host_and_port(igtl_address)
    volume = output.with_name(output.name.removesuffix(SUFFIX) + VOLUME_SUFFIX)
    check_file(output, (SUFFIX,), force=force)
    check_file(volume, force=force)
    header = read_header(scene)
    poses = header.training_poses
    pose = poses[len(poses) // 2] if len(poses) else np.eye(4)

    from ultragray import GaussianScene
    from ultragray.volumes.files import write_volume
    from ultragray.volumes.grid import VolumeGrid

    grid = VolumeGrid.over_scene(header.info, None, spacing_mm)
    with working(f"sampling {' x '.join(map(str, grid.shape))} points …"):
        write_volume(volume, GaussianScene.load(scene), "echo", grid)
    device = device_of(scene.stem)
    SlicerScene(host, port, device, pose, volume.name).write(output)
    image = image_name(device)
    document = {"file": str(output), "volume": str(volume), "device": device, "image": image, "address": igtl_address}
    tell(f"wrote {output} and {volume}: {device} is sent to {igtl_address}, {image} comes back", document, as_json=json)


def _host_and_port(address: str) -> tuple[str, int]:
    match = re.fullmatch(r"(?P<host>[^\s:]+|\[[0-9A-Fa-f:.]+\]):(?P<port>\d{1,5})", address)
    if match is None or not 1 <= int(match["port"]) <= 65535:
        raise InvalidArgument(
            f"igtl_address must be HOST:PORT such as 127.0.0.1:18944, got {address[:80]!r}", field="igtl_address"
        )
    return match["host"].strip("[]"), int(match["port"])

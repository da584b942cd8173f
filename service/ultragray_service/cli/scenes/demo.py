"""`ultragray demo`: the built-in scene as a file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from ultragray_service.cli.output import SCENE_SUFFIX, check_file
from ultragray_service.cli.style import Force, Json, command_group, examples, output_option, tell

command_app = command_group()


@command_app.command(epilog=examples("ultragray demo -o demo.ugr", "ultragray serve demo.ugr"))
def demo(
    output: Annotated[Path, output_option("Scene file to write (.ugr).", default="demo.ugr")] = Path("demo.ugr"),
    force: Force = False,
    json: Json = False,
) -> None:
    """It needs no data and no training: a first frame takes seconds."""
    from ultragray.demo import copy_demo_scene
    from ultragray.scene_info import read_header

    check_file(output, [SCENE_SUFFIX], force=force)
    copy_demo_scene(output)
    info = read_header(output).info
    tell(
        f"wrote {output}: {info.dataset_name}, {info.gaussian_count:,} Gaussians",
        {"output": str(output), "dataset_name": info.dataset_name, "gaussian_count": info.gaussian_count},
        as_json=json,
    )

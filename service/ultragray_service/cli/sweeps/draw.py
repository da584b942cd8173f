"""`ultragray draw`: the image planes of a sweep in space, and a contact sheet of its frames."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from ultragray.datasets.source import SourceOptions
from ultragray_service.cli.options import with_options
from ultragray_service.cli.output import check_file
from ultragray_service.cli.style import Force, Json, command_group, examples, output_option, tell
from ultragray_service.cli.sweeps.source import SweepArgument, check_source, read_dataset

command_app = command_group()


@command_app.command(epilog=examples("ultragray draw sweep/ -o sweep.png"))
@with_options
def draw(
    sweep: SweepArgument,
    output: Annotated[Path, output_option("Picture to write (.png).")],
    force: Force = False,
    json: Json = False,
    *,
    source: SourceOptions,
) -> None:
    """A mirrored image, a turned calibration or a jump of the tracker is seen at once."""
    check_file(output, [".png"], force=force)
    check_source(sweep)
    from ultragray.datasets.pictures import draw_dataset

    draw_dataset(read_dataset(sweep, source), output)
    tell(f"wrote {output}", {"output": str(output)}, as_json=json)

"""`ultragray show`: the description of a scene file or of a sweep, as a table or as JSON."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from ultragray.contract import to_dict
from ultragray.datasets.source import SourceOptions
from ultragray.errors import InvalidArgument
from ultragray_service.cli.options import with_options
from ultragray_service.cli.output import SCENE_SUFFIX
from ultragray_service.cli.style import Json, command_group, examples, to_json
from ultragray_service.cli.sweeps.source import SWEEP_MEANING, read_dataset

command_app = command_group()


@command_app.command(
    epilog=examples(
        "ultragray show liver.ugr",
        "ultragray show liver.ugr --json | jq .metrics",
        "ultragray show sweep/  # see also: ultragray check",
    )
)
@with_options
def show(
    file: Annotated[
        str,
        typer.Argument(metavar="FILE", help=f"A scene file (.ugr), or a sweep: {SWEEP_MEANING}.", show_default=False),
    ],
    json: Json = False,
    *,
    source: SourceOptions,
) -> None:
    """Of a scene: its size, probe, place, metrics and training. Of a sweep: its frames and probe.

    What looks wrong about a sweep is told by `ultragray check`.
    """
    if Path(file).suffix == SCENE_SUFFIX:
        if source != SourceOptions():
            raise InvalidArgument(f"options of sweeps are not for {file}, which is a scene file", field="source")
        document = describe_scene(Path(file))
    else:
        document = _describe_sweep(file, source)
    if json:
        typer.echo(to_json(document))
    else:
        print_facts(document)


def print_facts(document: dict[str, Any]) -> None:
    """A table of names and values for a person; what is unknown is left out."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    facts = {key: _text(value) for key, value in document.items() if value not in (None, {}, [])}
    console = Console()
    if not console.is_terminal:  # no padding for other programs, and nothing is cut
        width = max(map(len, facts), default=0)
        typer.echo("\n".join(f"{key:<{width}}  {text}" for key, text in facts.items()))
        return
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for key, text in facts.items():
        table.add_row(key, escape(text))  # a scene's own strings must not be read as markup
    console.print(table)


def describe_scene(path: Path) -> dict[str, Any]:
    """The fields of SceneInfo without hardness, the file, and a summary of the poses. Raises SceneFileInvalid."""
    from ultragray.files.atomic import file_sha256
    from ultragray.scene_info import read_header

    header = read_header(path)
    info, positions = header.info, header.training_poses[:, :3, 3]
    poses: dict[str, Any] = {"count": len(positions)}
    if len(positions):
        poses |= {"position_min_mm": positions.min(axis=0).tolist(), "position_max_mm": positions.max(axis=0).tolist()}
    return {
        "file": str(path),
        "sha256": file_sha256(path),
        "file_bytes": header.file_bytes,
        **asdict(info),
        "confidence": {key: value for key, value in info.confidence.items() if key != "hardness"},
        "probe": None if info.probe is None else to_dict(info.probe),
        "training_poses": poses,
    }


def _describe_sweep(source: str, options: SourceOptions) -> dict[str, Any]:
    dataset = read_dataset(source, options)
    frames = dataset.train
    positions = frames.poses[:, :3, 3]
    return {
        "file": source,
        "name": dataset.name,
        "sha256": dataset.sha256,
        "probe": to_dict(dataset.probe),
        "image_height": frames.height,
        "image_width": frames.width,
        "training_frames": len(dataset.train),
        "held_out_frames": len(dataset.val),
        "position_min_mm": positions.min(axis=0).tolist(),
        "position_max_mm": positions.max(axis=0).tolist(),
    }


def _text(value: Any) -> str:
    if isinstance(value, dict):
        return "  ".join(f"{key}={_text(item)}" for key, item in value.items())
    if isinstance(value, (list, tuple)):
        return "(" + ", ".join(_text(item) for item in value) + ")"
    if isinstance(value, float):
        return f"{value:.6g}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)

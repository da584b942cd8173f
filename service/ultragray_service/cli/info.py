"""`ultragray info`: the description in a scene file, as a table or as JSON."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ultragray.contract import to_dict
from ultragray.files.atomic import file_sha256
from ultragray.scene_info import SceneHeader, read_header


def print_json(path: Path) -> None:
    """One JSON object on stdout: the fields of SceneInfo without hardness, the file and a summary of the poses."""
    typer.echo(json.dumps(_describe(path, read_header(path)), indent=2))


def print_table(path: Path) -> None:
    """The same as a table, for people."""
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for key, value in _describe(path, read_header(path)).items():
        if value not in (None, {}, []):
            table.add_row(key, escape(_text(value)))  # a scene's own strings must not be read as markup
    Console().print(table)


def _describe(path: Path, header: SceneHeader) -> dict[str, Any]:
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


def _text(value: Any) -> str:
    if isinstance(value, dict):
        return "  ".join(f"{key}={_text(item)}" for key, item in value.items())
    if isinstance(value, (list, tuple)):
        return "(" + ", ".join(_text(item) for item in value) + ")"
    if isinstance(value, float):
        return f"{value:.6g}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)

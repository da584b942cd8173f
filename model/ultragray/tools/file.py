"""Tools in files: a JSON list of them, each an object with its kind."""

from __future__ import annotations

import json
from pathlib import Path

from ultragray.contract import from_dict, shown, under
from ultragray.errors import InvalidArgument
from ultragray.tools.tool import Tool


def load_tools(path: str | Path) -> tuple[Tool, ...]:
    """The tools of a `.json` file. Raises InvalidArgument, naming the file, the tool and what was expected."""
    path = Path(path)
    try:
        if not path.is_file():  # a pipe or a device would never end
            raise FileNotFoundError("no such file")
        document = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(document, list):
            raise InvalidArgument(f"it must hold a list of tools, got {shown(document)}")
        return tuple(_tool(number, one) for number, one in enumerate(document))
    except (OSError, ValueError, RecursionError) as error:  # InvalidArgument is a ValueError
        raise InvalidArgument(f"{path}: {error}", field="tools") from error


def _tool(number: int, document: object) -> Tool:
    with under(f"tools[{number}]"):
        return from_dict(Tool, document)

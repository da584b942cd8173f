"""What the code says of itself, under version control so that each change of it is read: `make generate` writes it.

web/openapi.json                    the HTTP interface, of which the console's types and forms are made
tests/documents/public_names.txt    the public names of the Python packages, with their signatures
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path

from . import http_api, python_api

ROOT = Path(__file__).resolve().parents[2]


def openapi() -> str:
    """The OpenAPI document."""
    return json.dumps(http_api.document(), indent=1, ensure_ascii=False) + "\n"


SNAPSHOTS: Mapping[str, Callable[[], str]] = {
    "web/openapi.json": openapi,
    "tests/documents/public_names.txt": python_api.snapshot,
}

if __name__ == "__main__":
    for name, text in SNAPSHOTS.items():
        (ROOT / name).write_text(text(), encoding="utf-8")

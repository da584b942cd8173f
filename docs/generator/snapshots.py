"""The HTTP interface under version control: the console's types and forms are made of it (`make generate`)."""

from __future__ import annotations

import json
from pathlib import Path

from . import interfaces

OPENAPI = Path(__file__).resolve().parents[2] / "web" / "openapi.json"


def openapi() -> str:
    """The OpenAPI document."""
    return json.dumps(interfaces.document(), indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    OPENAPI.write_text(openapi(), encoding="utf-8")

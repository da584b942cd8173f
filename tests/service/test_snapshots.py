"""The OpenAPI document is web/openapi.json, from which the console's types and lists are generated.

After a wanted change: ULTRAGRAY_UPDATE_SNAPSHOTS=1 pytest tests/service/test_snapshots.py, and read the difference.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import httpx

OPENAPI = Path(__file__).parents[2] / "web" / "openapi.json"


def test_openapi(http: httpx.Client) -> None:
    text = json.dumps(http.get("/openapi.json").json(), indent=1, ensure_ascii=False) + "\n"
    if os.environ.get("ULTRAGRAY_UPDATE_SNAPSHOTS") == "1":
        OPENAPI.write_text(text)
    assert json.loads(OPENAPI.read_text()) == json.loads(text), f"the public interface differs from {OPENAPI}"

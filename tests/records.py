"""What a file of measured figures says first: when, of which commit and on which machine they were taken."""

from __future__ import annotations

import os
import subprocess
from datetime import datetime, timezone
from typing import Any

from ultragray.machine import processor_name

from .surroundings import ROOT

_DESCRIBE = ("git", "describe", "--always", "--dirty", "--exclude=*", "--abbrev=12")


def origin() -> dict[str, Any]:
    return {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "commit": subprocess.run(_DESCRIBE, cwd=ROOT, capture_output=True, text=True).stdout.strip(),
        "machine": processor_name(),
        "cpus": os.cpu_count(),
    }

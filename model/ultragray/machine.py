"""The processor that figures were measured on, as a table names it."""

from __future__ import annotations

import platform
from pathlib import Path


def processor_name() -> str:
    """Model of the processor where the system tells it, else its architecture."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()

"""Facts about the machine that this process runs on."""

from __future__ import annotations

import os
import platform
from contextlib import suppress
from pathlib import Path

_GROUP_LIMITS = (  # of the control group that a container is
    Path("/sys/fs/cgroup/memory.max"),
    Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
)


def processor_name() -> str:
    """Model of the processor where the system tells it, else its architecture."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def memory_bytes() -> int:
    """The memory of the machine, or of the container where that may have less."""
    found = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    for limit in _GROUP_LIMITS:
        with suppress(OSError, ValueError):  # another layout, or "max": no limit
            found.append(int(limit.read_text(encoding="ascii")))
    return min(found)

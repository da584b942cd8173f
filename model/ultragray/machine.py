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
    """Name of the processor where the system tells it, else its architecture."""
    return _cpu_info().get("model name") or platform.processor() or platform.machine()


def processor_maker() -> str | None:
    """The maker as the processor names itself, such as AuthenticAMD, or its number on Arm; None where nothing tells."""
    told = _cpu_info()
    return told.get("vendor_id") or told.get("CPU implementer")


def processor_model() -> str | None:
    """The maker's numbers for the generation: a virtual machine often hides it from the name."""
    told = _cpu_info()
    if "cpu family" in told:
        return f"family {told['cpu family']}, model {told.get('model')}"
    return f"part {told['CPU part']}" if "CPU part" in told else None


def _cpu_info() -> dict[str, str]:
    """What Linux says of the first processor."""
    path = Path("/proc/cpuinfo")
    if not path.exists():
        return {}
    pairs = (line.partition(":") for line in reversed(path.read_text().splitlines()))
    return {name.strip(): value.strip() for name, _, value in pairs}  # the first of a name comes last, and stays


def memory_bytes() -> int:
    """The memory of the machine, or of the container where that may have less."""
    found = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    for limit in _GROUP_LIMITS:
        with suppress(OSError, ValueError):  # another layout, or "max": no limit
            found.append(int(limit.read_text(encoding="ascii")))
    return min(found)

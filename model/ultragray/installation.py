"""This installation and the machine that it runs on: the version, which every frame and report names, the extras that
bring optional packages, processor and memory.
"""

from __future__ import annotations

import os
import platform
import sys
from contextlib import suppress
from pathlib import Path

from ultragray.errors import ExtraMissing

__version__ = "0.1.0"

# The modules that are imported although the core's dependencies do not bring them, by the extra that does.
MODULES_OF_EXTRAS = {
    "serve": (
        *("cryptography", "fastapi", "fastapi_offline", "google", "grpc", "grpc_health", "grpc_reflection"),
        *("jwt", "limits", "opentelemetry", "prometheus_client", "psycopg", "python_multipart", "sqlalchemy"),
        *("fastcrc", "httptools", "starlette", "ultragray_proto", "uvicorn", "uvloop", "websockets"),
    ),
    "train": ("jinja2", "matplotlib"),
    "dicom": ("pydicom", "PIL"),
    "hdf5": ("h5py",),
    "mcap": ("mcap", "mcap_ros2"),
    "mesh": ("trimesh",),
    "nifti": ("nibabel",),
    "parquet": ("pyarrow",),
    "ray": ("ray",),
    "storage": ("obstore",),
    "tensorboard": ("tensorboardX",),
    "tracing": ("opentelemetry.exporter", "opentelemetry.sdk"),
    "video": ("av",),
    "zarr": ("zarr",),
}
_SINCE_PYTHON_311 = {"serve", "zarr"}  # FastAPI and zarr have no releases for Python 3.10
_CHECKOUT = Path(__file__).resolve().parents[2]


def extra_of(module: str) -> str | None:
    """The extra that brings a module; None where the core's dependencies do, or nothing of ours."""
    return _entry(module)[0]


def _entry(module: str) -> tuple[str | None, str]:
    """The extra that brings a module, and the module as the table names it: opentelemetry.sdk before opentelemetry."""
    parts = module.split(".")
    for name in (".".join(parts[:2]), parts[0]):
        for extra, modules in MODULES_OF_EXTRAS.items():
            if name in modules:
                return extra, name
    return None, module


def install_advice(extra: str) -> str:
    """The command that installs an extra into this installation, from where it was installed."""
    if extra in _SINCE_PYTHON_311 and sys.version_info < (3, 11):
        return "its releases need Python 3.11 or newer, this is Python 3.10"
    if not (_CHECKOUT / "proto" / "pyproject.toml").is_file():
        return f"pip install 'ultragray[{extra}]'"
    pip = ".venv/bin/pip" if Path(sys.prefix) == _CHECKOUT / ".venv" else "pip"
    stubs = "./proto " if extra == "serve" else ""  # in a checkout they need not come from a package index
    return f"{pip} install {stubs}'ultragray[{extra}]'"


def missing_extra(error: ImportError, purpose: str, *, field: str | None = None) -> ExtraMissing:
    """The error that says which package `purpose` needs and how to install it.

    Raises `error` again where it is about a module that no extra brings.
    """
    extra, module = _entry(error.name or "")
    if extra is None:
        raise error
    return ExtraMissing(f"{purpose} needs {module}, which is not installed: {install_advice(extra)}", field=field)


def c_library() -> tuple[Path, Path]:
    """libultragray and its header, ultragray.h: frames for programs without Python (docs/howto/engines.md)."""
    from ultragray import _cpu

    installed = Path(_cpu.__file__).parent
    return installed / "libultragray.so", installed / "include" / "ultragray.h"


_GROUP_LIMITS = (  # of the control group that a container is
    Path("/sys/fs/cgroup/memory.max"),
    Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
)


def processor_name() -> str:
    """Name of the processor where the system tells it, else its architecture."""
    return _cpu_info().get("model name") or platform.processor() or platform.machine()


def processor_maker() -> str | None:
    """The maker as the processor names itself, such as AuthenticAMD, or its number on Arm; None where nothing tells."""
    facts = _cpu_info()
    return facts.get("vendor_id") or facts.get("CPU implementer")


def processor_model() -> str | None:
    """The maker's numbers for the generation: a virtual machine often hides it from the name."""
    facts = _cpu_info()
    if "cpu family" in facts:
        return f"family {facts['cpu family']}, model {facts.get('model')}"
    return f"part {facts['CPU part']}" if "CPU part" in facts else None


def _cpu_info() -> dict[str, str]:
    path = Path("/proc/cpuinfo")
    if not path.exists():
        return {}
    pairs = (line.partition(":") for line in reversed(path.read_text().splitlines()))
    return {name.strip(): value.strip() for name, _, value in pairs}  # the first of a name comes last, and stays


def memory_bytes() -> int:
    """The memory of the machine, or of the container where that may have less."""
    limits = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    for limit in _GROUP_LIMITS:
        with suppress(OSError, ValueError):  # another layout, or "max": no limit
            limits.append(int(limit.read_text(encoding="ascii")))
    return min(limits)

"""What is installed: the version, which every frame and report names, and the extras that bring optional packages."""

from __future__ import annotations

import sys
from pathlib import Path

from ultragray.errors import ExtraMissing

__version__ = "0.1.0"

# The modules that are imported although the core's dependencies do not bring them, by the extra that does.
MODULES_OF_EXTRAS = {
    "serve": (
        *("cryptography", "dbos", "fastapi", "fastapi_offline", "google", "grpc", "grpc_health", "grpc_reflection"),
        *("jwt", "limits", "opentelemetry", "prometheus_client", "psycopg", "python_multipart", "sqlalchemy"),
        *("starlette", "ultragray_proto", "uvicorn", "uvloop", "websockets"),
    ),
    "train": ("jinja2", "matplotlib"),
    "dicom": ("pydicom",),
    "gym": ("gymnasium",),
    "hdf5": ("h5py",),
    "mcap": ("mcap", "mcap_ros2"),
    "ray": ("ray",),
    "storage": ("obstore",),
    "tensorboard": ("tensorboard",),
    "tracing": ("opentelemetry.exporter", "opentelemetry.sdk"),
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

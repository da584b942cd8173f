"""The formats by name: what they can hold, and where they are written. Needs no package of theirs."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass

from ...errors import ExtraMissing, InvalidArgument
from .exporter import Exporter

DTYPES = ("float32", "uint8")


@dataclass(frozen=True)
class Format:
    """One format. `dtypes`: the pixel types that it can hold, its default first; labels are uint8 in each."""

    suffix: str  # of its files
    dtypes: tuple[str, ...]
    module: str
    bmode_only: bool = False
    package: str | None = None  # what it needs, as it is imported
    extra: str | None = None  # of ours, that installs it


FORMATS: dict[str, Format] = {
    "npz": Format(".npz", ("float32", "uint8"), "npz"),
    "tar": Format(".tar", ("uint8", "float32"), "webdataset"),
    "zarr": Format(".zarr.zip", ("float32", "uint8"), "zarr_zip", package="zarr", extra="zarr"),
    "hdf5": Format(".h5", ("float32", "uint8"), "hdf5", package="h5py", extra="hdf5"),
    "dicom": Format(".dcm", ("uint8",), "dicom", bmode_only=True, package="pydicom", extra="dicom"),
    "plus": Format(".igs.mha", ("uint8",), "plus_sequence", bmode_only=True),
}


def check_format(name: str, outputs: Sequence[str], dtype: str | None) -> str:
    """The pixel type for these outputs in a format: `dtype`, or where that is None the format's default.

    Raises InvalidArgument for an unknown format, and for outputs or a type that it cannot hold.
    """
    if not isinstance(name, str) or name not in FORMATS:
        raise InvalidArgument(f"format must be one of {', '.join(FORMATS)}, got {name!r:.100}", field="format")
    chosen = FORMATS[name]
    if dtype is not None and (not isinstance(dtype, str) or dtype not in DTYPES):
        raise InvalidArgument(f"dtype must be one of {', '.join(DTYPES)}, got {dtype!r:.100}", field="dtype")
    if dtype is not None and dtype not in chosen.dtypes:
        raise InvalidArgument(f"dtype must be {chosen.dtypes[0]} in format {name}, got {dtype}", field="dtype")
    if chosen.bmode_only and tuple(outputs) != ("bmode",):
        told = ", ".join(outputs)
        raise InvalidArgument(f"outputs must be bmode alone in format {name}, got {told}", field="outputs")
    return dtype or chosen.dtypes[0]


def exporter_class(name: str) -> type[Exporter]:
    """The exporter of a format. Raises ExtraMissing where a package that it needs is not installed."""
    chosen = FORMATS[name]
    try:
        module = importlib.import_module(f".{chosen.module}", __package__)
    except ImportError as error:
        if chosen.package is None or (error.name or "").partition(".")[0] != chosen.package:
            raise
        raise ExtraMissing(
            f"format {name} needs {chosen.package}, which is not installed: pip install 'ultragray[{chosen.extra}]'",
            field="format",
        ) from error
    found: type[Exporter] = module.EXPORTER
    return found

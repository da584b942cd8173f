"""The registry of formats: what each can hold, and where it is written. Needs no package of theirs.

A new format is a module with an `EXPORTER` beside this one, and its line in `_ALL`.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ultragray.display.settings import true_to_scale
from ultragray.errors import InvalidArgument
from ultragray.installation import extra_of, missing_extra
from ultragray.interchange.exports.exporter import Exporter
from ultragray.settings import Resolved

DTYPES = ("float32", "uint8")


@dataclass(frozen=True)
class Format:
    """One format. `dtypes`: the pixel types that it can hold, its default first; labels are uint8 in each."""

    name: str
    suffix: str  # of its files
    meaning: str
    module: str
    dtypes: tuple[str, ...] = DTYPES
    bmode_only: bool = False
    in_mm: bool = False  # whether a pixel has one size in mm: fans are scan-converted
    package: str | None = None  # what it needs beyond the core's dependencies, as it is imported

    @property
    def extra(self) -> str | None:
        """The extra that brings its package."""
        return None if self.package is None else extra_of(self.package)

    def shown(self, settings: Resolved) -> Resolved:
        """The settings as frames have them in a file of this format: scan-converted where it must be."""
        if not self.in_mm or settings.display.pixel_mm is not None:
            return settings
        pixel_mm = true_to_scale(settings.probe, settings.height).pixel_mm
        return replace(settings, display=replace(settings.display, pixel_mm=pixel_mm))


_ALL = (
    Format("npz", ".npz", "NumPy arrays, the npz keys, not compressed; objects of the origin as JSON", "npz"),
    Format(
        "tar",
        ".tar",
        "WebDataset, for any reader of tar: 000000.bmode.png (float32: .npy) of each output and 000000.json with pose, "
        "figures and origin; then 000001 and so on",
        "webdataset",
        dtypes=("uint8", "float32"),
    ),
    Format(
        "zarr",
        ".zarr.zip",
        "A Zarr 3 group in a zip: an array of each output in chunks of a frame, poses, figures; origin as attributes",
        "zarr_zip",
        package="zarr",
    ),
    Format(
        "hdf5",
        ".h5",
        "HDF5: a data set of each output in chunks of a frame, poses, figures; origin as attributes, objects as JSON",
        "hdf5",
        package="h5py",
    ),
    Format(
        "dicom",
        ".dcm",
        "A DICOM ultrasound multi-frame image: bmode alone, true to scale",
        "dicom",
        dtypes=("uint8",),
        bmode_only=True,
        in_mm=True,
        package="pydicom",
    ),
    Format(
        "plus",
        ".igs.mha",
        "A PLUS sequence: bmode alone, true to scale",
        "plus_sequence",
        dtypes=("uint8",),
        bmode_only=True,
        in_mm=True,
    ),
    Format(
        "mcap",
        ".mcap",
        "MCAP, messages of ROS 2: a topic of images for each output, poses in metres, figures; origin as metadata",
        "mcap_file",
        dtypes=("uint8", "float32"),
        package="mcap_ros2",
    ),
)
FORMATS: dict[str, Format] = {format.name: format for format in _ALL}


def format_of(file_name: str) -> str | None:
    """The name of the format that the suffix of a file stands for; None where it stands for none."""
    return next((format.name for format in _ALL if file_name.endswith(format.suffix)), None)


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
        given = ", ".join(outputs)
        raise InvalidArgument(f"outputs must be bmode alone in format {name}, got {given}", field="outputs")
    return dtype or chosen.dtypes[0]


def exporter_class(name: str) -> type[Exporter]:
    """The exporter of a format. Raises ExtraMissing where a package that it needs is not installed."""
    chosen = FORMATS[name]
    try:
        module = importlib.import_module(f".{chosen.module}", __package__)
    except ImportError as error:
        raise missing_extra(error, f"format {name}", field="format") from error
    found: type[Exporter] = module.EXPORTER
    return found

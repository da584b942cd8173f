"""The formats of rendered frames by name, and files of them: whole or not at all, or as bytes.

Another package adds a format by an entry point of the group `ultragray.exporters`, which is a `Format`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

import numpy as np

from ultragray.errors import InvalidArgument
from ultragray.exchange.exports.exporter import Exporter, ExportHeader, stored_pixels
from ultragray.files import atomic_path
from ultragray.geometry.probe import Picture
from ultragray.installation import extra_of, missing_extra
from ultragray.rendering.display import true_to_scale
from ultragray.rendering.outputs import OUTPUTS
from ultragray.rendering.pixels import PixelArray
from ultragray.rendering.settings import Resolved
from ultragray.scene.confidence import Extrapolation

DTYPES = ("float32", "uint8")


@dataclass(frozen=True)
class Format:
    """One format. `dtypes`: the pixel types that it can hold, its default first; labels are uint8 in each."""

    name: str
    suffix: str  # of its files
    meaning: str
    exporter: str  # "module:class", imported when it writes
    dtypes: tuple[str, ...] = DTYPES
    bmode_only: bool = False
    in_mm: bool = False  # whether a pixel has one size in mm: fans are scan-converted
    package: str | None = None  # what it needs beyond the core's dependencies, as it is imported

    @property
    def extra(self) -> str | None:
        return None if self.package is None else extra_of(self.package)

    def shown(self, settings: Resolved) -> Resolved:
        """The settings as frames have them in a file of this format: scan-converted where it must be."""
        if not self.in_mm or settings.display.pixel_mm is not None:
            return settings
        pixel_mm = true_to_scale(settings.probe, settings.height).pixel_mm
        return replace(settings, display=replace(settings.display, pixel_mm=pixel_mm))


def frame_bytes(outputs: Sequence[str], dtype: str, picture: Picture) -> int:
    """The bytes that the pixels of a frame take in a file where they are not compressed."""
    pixel_bytes = sum(1 if OUTPUTS[name].is_numbers else np.dtype(dtype).itemsize for name in outputs)
    return picture.height * picture.width * pixel_bytes


_HERE = __package__
_ALL: tuple[Format, ...] = (
    Format(
        "npz",
        ".npz",
        "NumPy arrays, the npz keys, not compressed; objects of the origin as JSON",
        f"{_HERE}.archives:NpzExporter",
    ),
    Format(
        "tar",
        ".tar",
        "WebDataset, for any reader of tar: 000000.bmode.png (float32: .npy) of each output and 000000.json with pose, "
        "figures and origin; then 000001 and so on",
        f"{_HERE}.archives:TarExporter",
        dtypes=("uint8", "float32"),
    ),
    Format(
        "zarr",
        ".zarr.zip",
        "A Zarr 3 group in a zip: an array of each output in chunks of a frame, poses, figures; origin as attributes",
        f"{_HERE}.zarr_zip:ZarrExporter",
        package="zarr",
    ),
    Format(
        "hdf5",
        ".h5",
        "HDF5: a data set of each output in chunks of a frame, poses, figures; origin as attributes, objects as JSON",
        f"{_HERE}.hdf5:Hdf5Exporter",
        package="h5py",
    ),
    Format(
        "dicom",
        ".dcm",
        "A DICOM ultrasound multi-frame image: bmode alone, true to scale",
        f"{_HERE}.dicom:DicomExporter",
        dtypes=("uint8",),
        bmode_only=True,
        in_mm=True,
        package="pydicom",
    ),
    Format(
        "plus",
        ".igs.mha",
        "A PLUS sequence: bmode alone, true to scale",
        f"{_HERE}.plus_sequence:PlusExporter",
        dtypes=("uint8",),
        bmode_only=True,
        in_mm=True,
    ),
    Format(
        "mcap",
        ".mcap",
        "MCAP, messages of ROS 2: a topic of images for each output, poses in metres, figures; origin as metadata",
        f"{_HERE}.mcap_file:McapExporter",
        dtypes=("uint8", "float32"),
        package="mcap_ros2",
    ),
    Format(
        "parquet",
        ".parquet",
        "Parquet in the layout of Hugging Face datasets: a row a frame, with each output as a PNG, pose, figures and "
        "the scene's name; origin as metadata",
        f"{_HERE}.parquet:ParquetExporter",
        dtypes=("uint8",),
        package="pyarrow",
    ),
    *(point.load() for point in entry_points(group="ultragray.exporters")),
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
        names = ", ".join(outputs)
        raise InvalidArgument(f"outputs must be bmode alone in format {name}, got {names}", field="outputs")
    return dtype or chosen.dtypes[0]


def exporter_class(name: str) -> type[Exporter]:
    """The exporter of a format. Raises ExtraMissing where a package that it needs is not installed."""
    try:
        exporter: type[Exporter] = EntryPoint(name, FORMATS[name].exporter, "").load()
        return exporter
    except ImportError as error:
        raise missing_extra(error, f"format {name}", field="format") from error


@dataclass
class Writing:
    """The writing of rendered frames into a file: called with the next ones, in order."""

    add: Callable[[Mapping[str, PixelArray], Sequence[Extrapolation]], None]
    sha256: str | None = None  # of the file once it is whole, where it is known without reading it again

    def __call__(self, frames: Mapping[str, PixelArray], extrapolations: Sequence[Extrapolation]) -> None:
        """Write the next frames, each output [B, H, W], with the extrapolation of each, [B]. Raises OSError."""
        self.add(frames, extrapolations)


@contextmanager
def export_to(path: str | Path, format: str, header: ExportHeader) -> Iterator[Writing]:
    """The writing of a file; at the end `path` is there, whole, or not at all.

    Raises ExtraMissing, InvalidArgument, OSError.
    """
    with atomic_path(path) as temporary, _exporting(temporary, format, header) as writing:
        yield writing


@contextmanager
def _exporting(path: Path, format: str, header: ExportHeader) -> Iterator[Writing]:
    exporter = exporter_class(format)(path, header)

    def add(frames: Mapping[str, PixelArray], extrapolations: Sequence[Extrapolation]) -> None:
        outputs = header.settings.outputs
        stored = {name: stored_pixels(name, frames[name], header.pixel_type(name)) for name in outputs}
        exporter.add(stored, extrapolations)

    writing = Writing(add)
    try:
        yield writing
    except BaseException:
        exporter.abandon()
        raise
    exporter.close()
    writing.sha256 = exporter.sha256


def export_bytes(
    format: str, header: ExportHeader, frames: Mapping[str, PixelArray], extrapolations: Sequence[Extrapolation]
) -> bytes:
    """The file of a format with all frames, each output [C, H, W], and the extrapolation of each, [C].

    Raises ExtraMissing, InvalidArgument for frames that the format cannot hold, OSError.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "export")
        with _exporting(path, format, header) as add:
            add(frames, extrapolations)
        return path.read_bytes()

import json
import subprocess
import sys
import tarfile
import threading
import zipfile
from dataclasses import replace
from importlib.util import find_spec

import cv2
import h5py
import numpy as np
import pyarrow.parquet
import pydicom
import pytest
import zarr
from zarr.storage import ZipStore

from ultragray import LinearProbe
from ultragray.contract import to_dict
from ultragray.errors import ExtraMissing, InvalidArgument
from ultragray.exchange.exports import FORMATS, check_format, export_to
from ultragray.exchange.rendering import written_behind
from ultragray.files import file_sha256
from ultragray.installation import install_advice
from ultragray.rendering.settings import Contact, Resolved
from ultragray.scene.confidence import FIGURES, Extrapolation, figure_arrays

from .conftest import POSES, exported, header_of

INSTALLED = [name for name, one in FORMATS.items() if one.package is None or find_spec(one.package)]
PROBE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)
OUTPUTS = ("bmode", "echo", "labels")
TOLD = [Extrapolation(0.5 * number, 2.0 * number, 0.9 - 0.1 * number, 0.75) for number in range(5)]


def header(outputs=OUTPUTS, dtype="float32"):
    return header_of("npz", Resolved(PROBE, 6, 7, outputs), dtype=dtype)


def rendered(outputs=OUTPUTS):
    random = np.random.default_rng(1)
    return {
        name: random.integers(0, 5, (5, 6, 7), np.uint8) if name == "labels" else random.random((5, 6, 7), np.float32)
        for name in outputs
    }


def export(path, format, header):
    """Writes five frames in portions of two; what the file must hold, by output."""
    frames = rendered(header.settings.outputs)
    exported(path, format, header, frames, TOLD)
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]
    if header.dtype == "float32":
        return frames
    return {
        name: values if name == "labels" else np.rint(values * 255).astype(np.uint8) for name, values in frames.items()
    }


def of_npz(path):
    """Arrays, what else it tells, and the shape of the parts that can be read alone."""
    with zipfile.ZipFile(path) as archive:
        assert {entry.compress_type for entry in archive.infolist()} == {zipfile.ZIP_STORED}
    with np.load(path) as archive:
        arrays = dict(archive)
    assert set(arrays) == {*OUTPUTS, "poses", *FIGURES, *header().origin()}
    return arrays, {name: str(arrays[name]) for name in header().origin()}, None


def of_zarr(path):
    with ZipStore(path, mode="r") as store:
        group = zarr.open_group(store, mode="r")
        chunks = {group[name].chunks for name in OUTPUTS}
        return {name: array[:] for name, array in group.arrays()}, dict(group.attrs), chunks


def of_hdf5(path):
    with h5py.File(path) as file:
        told = {**file.attrs, "probe": json.loads(file.attrs["probe"])}
        return {name: array[:] for name, array in file.items()}, told, {file[name].chunks for name in OUTPUTS}


@pytest.mark.parametrize("dtype", ["float32", "uint8"])
@pytest.mark.parametrize(("format", "read"), [("npz", of_npz), ("zarr", of_zarr), ("hdf5", of_hdf5)])
def test_arrays(tmp_path, format, read, dtype):
    path = tmp_path / f"frames{FORMATS[format].suffix}"
    expected = export(path, format, header(dtype=dtype))
    arrays, told, chunks = read(path)
    for name, values in {**expected, **figure_arrays(TOLD), "poses": POSES}.items():
        assert arrays[name].dtype == values.dtype
        np.testing.assert_array_equal(arrays[name], values)
    assert (told["scene"], told["scene_sha256"], told["renderer"]) == ("one", "0" * 64, "ultragray/0 cpu")
    if format != "npz":
        assert (told["probe"], chunks) == (to_dict(PROBE), {(1, 6, 7)})


def test_the_share_of_contact_is_there_where_it_was_asked_for(tmp_path):
    judged = replace(header(("bmode",)), settings=replace(header(("bmode",)).settings, contact=Contact.AIR))
    told = [replace(one, contact_share=number / 4) for number, one in enumerate(TOLD)]
    dtypes = {"npz": "float32", "hdf5": "float32", "tar": "uint8", "dicom": "uint8", "plus": "uint8"}
    for format, dtype in dtypes.items():
        asked = replace(judged, dtype=dtype)
        path = tmp_path / f"frames{FORMATS[format].suffix}"
        exported(path, format, asked, rendered(("bmode",)), told)
    shares = [one.contact_share for one in told]
    with np.load(tmp_path / "frames.npz") as archive:
        assert archive["contact_share"].tolist() == shares
        assert str(archive["contact"]) == "air"
    with h5py.File(tmp_path / "frames.h5") as file:
        assert file["contact_share"][:].tolist() == shares
    with tarfile.open(tmp_path / "frames.tar") as tar:
        file = tar.extractfile("000003.json")
        assert json.load(file)["contact_share"] == 0.75
    data = pydicom.dcmread(tmp_path / "frames.dcm")
    figures = np.frombuffer(data.private_block(0x0019, "ULTRAGRAY")[0x02].value, "<f4").reshape(5, -1)
    assert figures[:, 4].tolist() == shares
    sequence = (tmp_path / "frames.igs.mha").read_bytes()
    assert b"UltraGRayContact = air" in sequence
    assert b"Seq_Frame0002_UltraGRayContactShare = 5.000000e-01" in sequence


def test_tar_loads_with_the_standard_library(tmp_path):
    expected = export(tmp_path / "frames.tar", "tar", header(dtype="uint8"))
    with tarfile.open(tmp_path / "frames.tar") as tar:
        parts = [*(f"{name}.png" for name in OUTPUTS), "json"]
        assert tar.getnames() == [f"{number:06d}.{part}" for number in range(5) for part in parts]
        for name, values in expected.items():
            file = tar.extractfile(f"000004.{name}.png")
            pixels = cv2.imdecode(np.frombuffer(file.read(), np.uint8), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(pixels, values[4])
        file = tar.extractfile("000002.json")
        told = json.load(file)
    assert told["pose"] == POSES[2].tolist()
    assert {name: told[name] for name in FIGURES} == TOLD[2].figures()
    assert told["probe"] == to_dict(PROBE)


def test_parquet_is_a_data_set_of_hugging_face(tmp_path):
    expected = export(tmp_path / "frames.parquet", "parquet", header(dtype="uint8"))
    table = pyarrow.parquet.read_table(tmp_path / "frames.parquet")
    told = {name.decode(): json.loads(text) for name, text in table.schema.metadata.items()}
    features = told["huggingface"]["info"]["features"]
    assert list(features) == table.column_names == ["scene", "frame", *OUTPUTS, "pose", *FIGURES]
    assert {features[name]["_type"] for name in OUTPUTS} == {"Image"}
    rows = table.to_pylist()
    for number, row in enumerate(rows):
        assert (row["scene"], row["frame"], row["pose"]) == ("one", number, POSES[number].tolist())
        assert {name: row[name] for name in FIGURES} == pytest.approx(TOLD[number].figures())
        for name, values in expected.items():
            pixels = cv2.imdecode(np.frombuffer(row[name]["bytes"], np.uint8), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(pixels, values[number])
    assert (len(rows), told["ultragray"]["probe"]) == (5, to_dict(PROBE))


@pytest.mark.parametrize("format", INSTALLED)
def test_whole_or_not_at_all(tmp_path, format):
    asked = header(("bmode",), FORMATS[format].dtypes[0])
    path = tmp_path / f"frames{FORMATS[format].suffix}"
    path.write_text("before")

    def break_off():
        with export_to(path, format, asked) as add:
            add({"bmode": rendered()["bmode"][:3]}, TOLD[:3])
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        break_off()
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
    assert path.read_text() == "before"


@pytest.mark.parametrize("format", INSTALLED)
def test_what_is_written_from_end_to_end_is_hashed_on_the_way(tmp_path, format):
    outputs = ("bmode",) if FORMATS[format].bmode_only else ("bmode", "coverage")
    path = tmp_path / f"frames{FORMATS[format].suffix}"
    with export_to(path, format, header(outputs, FORMATS[format].dtypes[0])) as writing:
        writing(rendered(outputs), TOLD)
    assert writing.sha256 == (file_sha256(path) if format in ("npz", "tar") else None)


@pytest.mark.parametrize("format", INSTALLED)
def test_the_same_frames_make_the_same_file(tmp_path, format):
    asked = header(("bmode",), FORMATS[format].dtypes[0])
    written = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        path = tmp_path / name / f"frames{FORMATS[format].suffix}"
        export(path, format, asked)
        written.append(path.read_bytes())
    if format in ("npz", "zarr"):  # zip members carry the time
        assert len(written[0]) == len(written[1])
    else:
        assert written[0] == written[1]


def test_a_portion_is_written_while_the_next_is_rendered():
    written, given = [], []
    may_write = threading.Event()

    def write(number):
        assert may_write.wait(300)
        written.append(number)

    def give():
        with written_behind(write) as later:
            for number in range(4):
                later(number)
                given.append(number)

    giving = threading.Thread(target=give)
    giving.start()
    giving.join(0.3)
    assert len(given) < 2  # the first is being written; the next has to wait
    assert not written
    may_write.set()
    giving.join()
    assert written == [0, 1, 2, 3]


FULL_DISK = """
import errno, pathlib, resource, sys
sys.path[:] = {path!r}
import numpy as np
from ultragray import LinearProbe
from ultragray.exchange.exports import FORMATS, ExportHeader, export_to, exporter_class
from ultragray.rendering.settings import Resolved
from ultragray.scene.confidence import Extrapolation

for format in {formats!r}:
    exporter_class(format)
poses, settings = np.tile(np.eye(4), (40, 1, 1)), Resolved(LinearProbe(40.0, 0.0, 50.0), 300, 300)
frames = np.random.default_rng(0).random((4, 300, 300), np.float32)
resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, resource.RLIM_INFINITY))
for format in {formats!r}:
    header = ExportHeader(settings, FORMATS[format].dtypes[0], poses, "one", "0" * 64, "r")
    try:
        with export_to(pathlib.Path({folder!r}, "frames"), format, header) as add:
            for _ in range(10):
                add({{"bmode": frames}}, [Extrapolation(1.0, 1.0, 0.5, 0.5)] * 4)
    except OSError as error:
        print(format, errno.errorcode[error.errno])
"""


def test_a_full_disk_is_told_as_such(tmp_path):
    program = FULL_DISK.format(path=sys.path, folder=str(tmp_path), formats=INSTALLED)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.splitlines() == [f"{format} EFBIG" for format in INSTALLED], done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("format", "outputs", "dtype", "field", "told"),
    [
        ("zip", ("bmode",), None, "format", "one of npz, tar, zarr, hdf5, dicom, plus, mcap"),
        (["npz"], ("bmode",), None, "format", "one of"),
        ("npz", ("bmode",), "int8", "dtype", "float32, uint8"),
        ("npz", ("bmode",), 8, "dtype", "float32, uint8"),
        ("dicom", ("bmode",), "float32", "dtype", "uint8 in format dicom"),
        ("plus", ("bmode", "echo"), None, "outputs", "bmode alone in format plus"),
        ("dicom", ("labels",), None, "outputs", "bmode alone"),
    ],
)
def test_what_a_format_cannot_hold(format, outputs, dtype, field, told):
    with pytest.raises(InvalidArgument, match=told) as caught:
        check_format(format, outputs, dtype)
    assert caught.value.field == field


@pytest.mark.parametrize(
    ("format", "package"), [("zarr", "zarr"), ("hdf5", "h5py"), ("dicom", "pydicom"), ("mcap", "mcap_ros2")]
)
def test_a_missing_package_is_named_with_its_extra(tmp_path, format, package):
    program = (
        f"import sys; sys.path[:] = {sys.path!r}; sys.modules[{package!r}] = None\n"
        "from ultragray.errors import ExtraMissing\n"
        "from ultragray.exchange.exports import exporter_class\n"
        f"try: exporter_class({format!r})\n"
        "except ExtraMissing as error: print(error)\n"
        "print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [
        f"format {format} needs {package}, which is not installed: {install_advice(format)}",
        "False",
    ]
    assert ExtraMissing.reason == "EXTRA_MISSING"

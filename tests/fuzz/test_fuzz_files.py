"""Every file format that is read: a damaged file is read or refused in words, in little time and memory."""

import contextlib
import io
import json
import struct
import tarfile
import warnings
import zipfile
import zlib

import cv2
import h5py
import numpy as np
import pydicom
import pytest
import torch
from hypothesis import strategies as st
from mcap.writer import CompressionType
from pydicom.encaps import encapsulate
from pydicom.uid import JPEGBaseline8Bit

from ultragray.datasets import Dataset
from ultragray.datasets.released import write_released
from ultragray.exchange.ply import write_ply
from ultragray.learn.training import train
from ultragray.learn.training.trainer import CHECKPOINT_FILE

from ..dicom_files import FRAMES, write_cine
from ..mcap_files import Bag
from ..model.datasets.conftest import (
    DEVICE_SET,
    IMAGE_TO_PROBE,
    make_sweep,
    numbers,
    speckle,
    tracked_fields,
    write_mha,
    write_nrrd,
)
from ..model.learn.conftest import make_tiny_config, make_tiny_dataset
from .mutations import as_json, chosen_parts, mutated_bytes, mutated_json, mutated_lines, places
from .reading import ReaderProcess

__all__ = ["make_sweep"]

pytestmark = pytest.mark.long

_LENGTH_BYTES = 8
HOSTILE_NAMES = (
    "../up.npy",
    "/etc/up",
    "a/../../b",
    "\0",
    "x" * 300,
    "a" * 150 + "/" + "b" * 190,
    "conf.json/deeper",
    "",
)


@pytest.fixture
def open_reader(tmp_path):
    opened = []

    def open_(name):
        folder = tmp_path / f"reader-{len(opened)}"
        folder.mkdir()
        opened.append(ReaderProcess(name, folder))
        return opened[-1]

    yield open_
    for reader in opened:
        reader.close()


def mutated_bundle(data):
    """A safetensors bundle whose header is another document, or whose bytes are changed."""
    length = int.from_bytes(data[:_LENGTH_BYTES], "little")
    header, tensors = json.loads(data[_LENGTH_BYTES : _LENGTH_BYTES + length]), data[_LENGTH_BYTES + length :]

    def pack(document):
        text = as_json(document)
        return len(text).to_bytes(_LENGTH_BYTES, "little") + text + tensors

    def with_metadata(metadata):
        (key,) = header["__metadata__"]
        return pack({**header, "__metadata__": {key: json.dumps(metadata)}})

    metadata = json.loads(next(iter(header["__metadata__"].values())))
    numbers_changed = mutated_bytes([tensors]).map(lambda changed: data[: -len(tensors)] + changed)
    same_size = numbers_changed.map(lambda changed: changed[: len(data)].ljust(len(data), b"\0"))
    return st.one_of(
        mutated_json([metadata]).map(with_metadata), mutated_json([header]).map(pack), same_size, mutated_bytes([data])
    )


def test_scenes(door, open_reader, demo_scene, tmp_path):
    demo_scene.save(tmp_path / "whole.ugr")
    reader = open_reader("scene")
    inputs = mutated_bundle((tmp_path / "whole.ugr").read_bytes())
    door("scene files").enter(inputs, lambda data: reader.read_file("scene.ugr", data))


def test_compressed_scenes(door, open_reader, demo_scene):
    """Damage is found by checksums: these are put right again, so that what lies behind them is reached."""
    data = demo_scene.to_compressed_bytes()
    header = json.loads(data[_LENGTH_BYTES : _LENGTH_BYTES + int.from_bytes(data[:_LENGTH_BYTES], "little")])
    (name,) = (name for name in header if name.startswith("part."))  # its Gaussians are few; it ends the file
    begin = len(data) - header[name]["shape"][0]

    def with_checksum(part):
        part = part[: len(data) - begin - 4].ljust(len(data) - begin - 4, b"\0")
        return data[:begin] + part + zlib.crc32(part).to_bytes(4, "little")

    reader = open_reader("scene")
    inputs = st.one_of(mutated_bytes([data[begin:]]).map(with_checksum), mutated_bundle(data))
    door("compressed scene files").enter(inputs, lambda changed: reader.read_file("scene.ugz", changed))


def test_ply(door, open_reader, demo_scene, tmp_path):
    write_ply(demo_scene, tmp_path / "whole.ply")
    data = (tmp_path / "whole.ply").read_bytes()
    head, mark, tail = data.partition(b"end_header\n")
    inputs = st.one_of(
        mutated_lines(head + mark, tail), mutated_bytes([data]), mutated_bytes([head]).map(lambda h: h + mark + tail)
    )
    reader = open_reader("ply")
    door("ply files").enter(inputs, lambda changed: reader.read_file("scene.ply", changed))


@pytest.fixture
def released(make_sweep, tmp_path):
    """The files of a folder in the released layout."""
    write_released(Dataset("tiny", make_sweep(8), make_sweep(2)), tmp_path / "released")
    return {path.name: path.read_bytes() for path in (tmp_path / "released").iterdir()}


def mutated_array(data):
    """An .npy file with another header, other numbers, or other bytes."""
    array = np.load(io.BytesIO(data))

    def with_header(document):
        text = document.encode("utf-8", "surrogatepass")
        return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text) % 2**16) + text + array.tobytes()

    shapes = st.lists(st.sampled_from([0, 1, -1, 2, 3, 4, 16, 20, 10**9, 2**63, 2**70]), max_size=5).map(tuple)
    kinds = st.sampled_from(
        ["<f8", "|u1", "<f4", ">f8", "|O", "<c16", "<i8", "|b1", "|S3", "<U9", "<m8", "<f2", "|V8", "?", "x"]
    )
    header = st.builds(
        lambda shape, kind, fortran: repr({"descr": kind, "fortran_order": fortran, "shape": shape}) + "\n",
        st.one_of(st.just(array.shape), shapes),
        st.one_of(st.just(array.dtype.str), kinds),
        st.booleans(),
    )
    numbers_changed = mutated_bytes([array.tobytes()]).map(
        lambda changed: data[: -array.nbytes] + changed[: array.nbytes].ljust(array.nbytes, b"\0")
    )
    return st.one_of(header.map(with_header), numbers_changed, mutated_bytes([data]))


def mutated_released(files):
    conf = json.loads(files["conf.json"])
    parts = {name: mutated_array(data) for name, data in files.items() if name.endswith(".npy")}
    parts["conf.json"] = st.one_of(mutated_json([conf]).map(as_json), mutated_bytes([files["conf.json"]]))
    return chosen_parts(files, parts)


def test_released_folders(door, open_reader, released):
    reader = open_reader("folder")
    door("released folders").enter(mutated_released(released), reader.read_files)


def test_pose_files(door, open_reader, released):
    reader, opened = open_reader("poses"), door("pose files")
    poses = np.load(io.BytesIO(released["poses_train.npy"]))
    opened.enter(
        mutated_array(released["poses_train.npy"]), lambda data: reader.read_file("poses.npy", data), share=0.5
    )
    as_lists = mutated_json([poses.tolist(), poses[0].tolist(), poses[:, :3].tolist()]).map(as_json)
    opened.enter(as_lists, lambda data: reader.read_file("poses.json", data), share=0.4)
    text = json.dumps(poses[:2].tolist()).encode()
    opened.enter(mutated_bytes([text]), lambda data: reader.read_file("poses.json", data), share=0.1)


def stored_again(data, name, content):
    """An archive as torch writes it, with other bytes in one of its entries."""
    packed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as new:
        for entry in old.infolist():
            new.writestr(entry.filename, content if entry.filename == name else old.read(entry))
    return packed.getvalue()


def test_released_checkpoints(door, open_reader, demo_scene, released, tmp_path):
    packed = io.BytesIO()
    torch.save({"step": 3, "splats": demo_scene.splats}, packed)
    data = packed.getvalue()
    with zipfile.ZipFile(packed) as archive:
        pickled = next(name for name in archive.namelist() if name.endswith("data.pkl"))
        program = archive.read(pickled)
    checkpoints = st.one_of(
        mutated_bytes([program]).map(lambda changed: stored_again(data, pickled, changed)), mutated_bytes([data])
    )
    files = {name: released[name] for name in ("conf.json", "poses_train.npy", "images_train.npy")} | {"ckpt.pt": data}
    parts = {"ckpt.pt": checkpoints, "conf.json": mutated_released(released).map(lambda changed: changed["conf.json"])}
    reader = open_reader("checkpoint")
    door("checkpoints").enter(chosen_parts(files, parts), reader.read_files)


def test_training_states(door, open_reader, tmp_path):
    train(make_tiny_dataset(), make_tiny_config(), folder=tmp_path / "run", should_stop=lambda: True)
    inputs = mutated_bundle((tmp_path / "run" / CHECKPOINT_FILE).read_bytes())
    reader = open_reader("training state")
    door("training states").enter(inputs, lambda data: reader.read_file("state", data))


def test_sequences(door, open_reader, tmp_path):
    stored, fields = speckle(6, 20, 16), {"UltrasoundImageOrientation": "MF", **tracked_fields(6)}
    device_set = DEVICE_SET.format(matrix=numbers(IMAGE_TO_PROBE)).encode()
    written = [
        write_mha(tmp_path / "packed.mha", stored, fields),
        write_mha(tmp_path / "raw.mha", stored, fields, deflate=False),
        write_nrrd(tmp_path / "packed.nrrd", stored, fields),
        write_nrrd(tmp_path / "raw.nrrd", stored, fields, encoding="raw"),
    ]
    opened = door("sequences")
    for path in written:
        reader = open_reader("sequence")
        data = path.read_bytes()
        mark = b"LOCAL\n" if path.suffix == ".mha" else b"\n\n"
        end = data.index(mark) + len(mark)
        parts = {
            path.name: st.one_of(mutated_lines(data[:end], data[end:]), mutated_bytes([data])),
            "device_set.xml": st.one_of(mutated_bytes([device_set]), mutated_lines(device_set, b"")),
        }
        whole = {path.name: data, "device_set.xml": device_set}
        opened.enter(chosen_parts(whole, parts), reader.read_files, share=1 / len(written))


def mutated_cine(path):
    """A DICOM file with other values of its elements, or other bytes."""
    data = path.read_bytes()
    values = st.one_of(
        st.sampled_from(
            ["", "1", "-1", "0", "65536", "MONOCHROME1", "1e308", "nan", "x" * 70, "1\\2", "CURVED LINEAR"]
        ),
        st.integers(-1, 2**31),
    )

    def with_elements(changes):
        dataset = pydicom.dcmread(io.BytesIO(data))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for place, value in changes:
                elements = [one for one in dataset.iterall() if one.VR != "SQ" and one.keyword != "PixelData"]
                chosen = elements[int(place * len(elements))]
                with contextlib.suppress(Exception):  # a value that pydicom does not take at all
                    chosen.value = int(value) if chosen.VR in ("US", "UL") else str(value)
            written = io.BytesIO()
            try:
                dataset.save_as(written)
            except Exception:  # or does not write
                return data
        return written.getvalue()

    header = mutated_bytes([data[: -FRAMES.nbytes]]).map(lambda changed: changed + data[-FRAMES.nbytes :])
    changes = st.lists(st.tuples(places, values), min_size=1, max_size=3)
    return st.one_of(changes.map(with_elements), header, mutated_bytes([data]))


def test_dicom(door, open_reader, tmp_path):
    path = write_cine(tmp_path)
    poses = (tmp_path / "sweep.poses.npy").read_bytes()
    whole = {"sweep.dcm": path.read_bytes(), "sweep.poses.npy": poses}
    parts = {"sweep.dcm": mutated_cine(path), "sweep.poses.npy": mutated_array(poses)}
    reader = open_reader("folder")
    door("dicom").enter(chosen_parts(whole, parts), reader.read_files)


def test_jpeg_streams_of_dicom(door, open_reader, tmp_path):
    """Colours that header and stream call differently, in streams that are nearly right."""
    colour = np.repeat(speckle(10, 24, 32)[..., None], 3, axis=-1)
    streams = [cv2.imencode(".jpg", frame)[1].tobytes() for frame in colour]
    described = {"SamplesPerPixel": 3, "PhotometricInterpretation": "RGB", "PlanarConfiguration": 0}
    path = write_cine(tmp_path, syntax=JPEGBaseline8Bit, data=encapsulate(streams), **described)
    whole = {"sweep.dcm": path.read_bytes(), "sweep.poses.npy": (tmp_path / "sweep.poses.npy").read_bytes()}
    parts = {"sweep.dcm": st.one_of(mutated_cine(path), mutated_bytes([whole["sweep.dcm"]]))}
    reader = open_reader("folder")
    door("jpeg in dicom").enter(chosen_parts(whole, parts), reader.read_files)


def test_tables_of_poses(door, open_reader):
    rows = "".join(f"{n / 10},0,{n},0,1,0,0,0\n" for n in range(6))
    calibration = {"image_to_sensor": IMAGE_TO_PROBE.tolist(), "position_unit": "mm", "euler_order": "ZYX"}
    whole = {
        **{f"{n}.png": cv2.imencode(".png", frame)[1].tobytes() for n, frame in enumerate(speckle(6, 20, 16))},
        "poses.csv": f"time,x,y,z,qw,qx,qy,qz\n{rows}".encode(),
        "calibration.json": json.dumps(calibration).encode(),
    }
    parts = {
        "poses.csv": st.one_of(mutated_lines(whole["poses.csv"], b""), mutated_bytes([whole["poses.csv"]])),
        "calibration.json": mutated_json([calibration]).map(as_json),
        "3.png": mutated_bytes([whole["3.png"]]),
    }
    reader = open_reader("folder")
    door("tables of poses").enter(chosen_parts(whole, parts), reader.read_files)


def test_scans_of_tus_rec(door, open_reader, tmp_path):
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        file["frames"], file["tforms"] = speckle(6, 20, 16), np.tile(np.eye(4), (6, 1, 1))
    matrix = "0.2,0,0,0\n0,0.2,0,0\n0,0,1,0\n0,0,0,1\n"
    whole = {
        "scan.h5": (tmp_path / "scan.h5").read_bytes(),
        "calib_matrix.csv": f"scaling\n{matrix}spatial_calibration\n{matrix.replace('0.2', '1')}".encode(),
    }
    parts = {
        "scan.h5": mutated_bytes([whole["scan.h5"]]),
        "calib_matrix.csv": mutated_lines(whole["calib_matrix.csv"], b""),
    }
    reader = open_reader("folder")
    door("scans of TUS-REC").enter(chosen_parts(whole, parts), reader.read_files)


def test_mcap(door, open_reader, tmp_path):
    """Uncompressed chunks without checksums: changed bytes get as far as the messages."""
    bag = Bag(tmp_path / "sweep.mcap", CompressionType.NONE, enable_crcs=False)
    bag.geometry()
    bag.poses()
    bag.images()
    whole = {"sweep.mcap": bag.finish().read_bytes()}
    reader = open_reader("folder")
    door("mcap").enter(mutated_bytes([whole["sweep.mcap"]]).map(lambda data: {"sweep.mcap": data}), reader.read_files)


def packed(entries, kind):
    """An archive of these entries, whatever their names."""
    target = io.BytesIO()
    if kind == "zip":
        with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of names that come twice
            for name, data in entries:
                archive.writestr(name.partition("\0")[0] or "empty", data)
    else:
        with tarfile.open(fileobj=target, mode="w:gz" if kind == "tar.gz" else "w") as tape:
            for name, data in entries:
                entry = tarfile.TarInfo(name)
                entry.size = len(data)
                entry.type = {3: tarfile.SYMTYPE, 4: tarfile.LNKTYPE, 5: tarfile.FIFOTYPE}.get(
                    len(data), tarfile.REGTYPE
                )
                tape.addfile(entry, io.BytesIO(data))
    return target.getvalue()


def test_archives(door, open_reader, released):
    names = st.one_of(st.sampled_from([*HOSTILE_NAMES, *released]), st.text(max_size=30).filter(str.isprintable))
    entries = st.lists(
        st.tuples(names, st.one_of(st.sampled_from(list(released.values())), st.binary(max_size=9))), max_size=5
    )
    kinds = st.sampled_from(["zip", "tar", "tar.gz"])
    whole = [packed(list(released.items()), kind) for kind in ("zip", "tar", "tar.gz")]
    reader = open_reader("archive")
    inputs = st.one_of(st.builds(packed, entries, kinds), mutated_bytes(whole), mutated_bytes(whole))

    def read(data):
        reader.read_file("upload", data)

    door("archives").enter(inputs, read)

"""Small sweeps, and PLUS sequence files of them, made by hand."""

import gzip
import zlib
from types import SimpleNamespace

import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.datasets import Sweep

IMAGE_TO_PROBE = np.array([[0.2, 0.0, 0, -3.0], [0.0, 0.0, 1, 1.0], [0.0, 0.1, 0, 2.0], [0, 0, 0, 1.0]])
DEVICE_SET = """<PlusConfiguration version="2.1"><CoordinateDefinitions>
<Transform From="Image" To="Probe" Matrix="{matrix}" Error="1.6"/>
</CoordinateDefinitions></PlusConfiguration>"""


def numbers(matrix):
    return " ".join(repr(float(value)) for value in matrix.ravel())


def translation(*offset):
    matrix = np.eye(4)
    matrix[:3, 3] = offset
    return matrix


def speckle(count, height, width, seed=0):  # [count, height, width]
    return np.random.default_rng(seed).integers(0, 250, (count, height, width), dtype=np.uint8)


def tracked_fields(count):
    """A probe that moves 1 mm a frame along the tracker's y, as the fields of its frames."""
    return {
        key: value
        for frame in range(count)
        for key, value in (
            (f"Seq_Frame{frame:04d}_ProbeToTrackerTransform", numbers(translation(10, frame, 0))),
            (f"Seq_Frame{frame:04d}_ProbeToTrackerTransformStatus", "OK"),
        )
    }


def write_mha(path, stored, fields, *, deflate=True, data_file="LOCAL"):
    """Stored frames [F, rows, columns] or [F, rows, columns, 3] as MetaImage."""
    payload = zlib.compress(stored.tobytes()) if deflate else stored.tobytes()
    count, rows, columns, *channels = stored.shape
    header = {
        "ObjectType": "Image",
        "NDims": "3",
        "BinaryData": "True",
        "CompressedData": str(deflate),
        "CompressedDataSize": f"{len(payload)}          ",
        "DimSize": f"{columns}  {rows} {count}              ",
        "ElementSpacing": "1 1 1",
        "ElementType": "MET_UCHAR",
        **({"ElementNumberOfChannels": str(channels[0])} if channels else {}),
        **fields,
        "ElementDataFile": data_file,
    }
    text = "".join(f"{key} = {value}\n" for key, value in header.items()).encode()
    if data_file == "LOCAL":
        path.write_bytes(text + payload)
    else:
        path.write_bytes(text)
        (path.parent / data_file).write_bytes(payload)
    return path


def write_nrrd(path, stored, fields, **changes):
    """The same as NRRD, gzip unless `encoding` says raw."""
    count, rows, columns, *channels = stored.shape
    header = {
        "type": "unsigned char",
        "dimension": str(stored.ndim),
        "sizes": " ".join(map(str, [*channels, columns, rows, count])),
        "kinds": " ".join([*("vector" for _ in channels), "domain", "domain", "list"]),
        "encoding": "gzip",
        **changes,
    }
    payload = stored.tobytes() if header["encoding"] == "raw" else gzip.compress(stored.tobytes())
    lines = ["NRRD0004", "# a comment: with a colon", *(f"{key}: {value}" for key, value in header.items())]
    lines += [f"{key}:={value}" for key, value in fields.items()]
    text = ("\n".join(lines) + "\n").encode()
    if "data file" in changes:
        path.write_bytes(text)
        (path.parent / changes["data file"]).write_bytes(payload)
    else:
        path.write_bytes(text + b"\n" + payload)
    return path


@pytest.fixture
def plus_files():
    """The writers above, for tests."""
    return SimpleNamespace(
        image_to_probe=IMAGE_TO_PROBE,
        numbers=numbers,
        translation=translation,
        speckle=speckle,
        tracked_fields=tracked_fields,
        write_mha=write_mha,
        write_nrrd=write_nrrd,
    )


@pytest.fixture
def device_set(tmp_path):
    path = tmp_path / "device_set.xml"
    path.write_text(DEVICE_SET.format(matrix=numbers(IMAGE_TO_PROBE)))
    return path


@pytest.fixture
def make_sweep():
    def make(count=10, *, step_mm=1.0, **changes):
        """Frames 40 mm wide and 50 mm deep that move along the elevation."""
        poses = np.tile(np.eye(4), (count, 1, 1))
        poses[:, :3, 3] = [(5.0, frame * step_mm, 7.0) for frame in range(count)]
        values = {
            "images": speckle(count, 20, 16),
            "poses": poses,
            "probe": LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0),
            "frame_numbers": np.arange(count),
            "source": "sweep",
        }
        return Sweep(**(values | changes))

    return make

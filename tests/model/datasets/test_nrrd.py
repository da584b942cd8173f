"""NRRD sequences, as PLUS and 3D Slicer write them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ultragray.datasets.plus_files import read_nrrd
from ultragray.errors import DatasetInvalid


@pytest.mark.parametrize(
    "changes",
    [{}, {"encoding": "raw"}, {"encoding": "gz"}, {"data file": "s.raw", "encoding": "raw"}, {"data file": "s.raw.gz"}],
)
def test_pixels_and_fields(tmp_path: Path, plus_files: SimpleNamespace, changes: dict[str, str]) -> None:
    stored = plus_files.speckle(3, 5, 7)
    fields = {"ultrasound image orientation": "MN", **plus_files.tracked_fields(3)}
    sequence = read_nrrd(plus_files.write_nrrd(tmp_path / "s.seq.nrrd", stored, fields, **changes))
    np.testing.assert_array_equal(sequence.pixels, stored)
    assert sequence.fields == {"ultrasound image orientation": "MN"}
    assert sequence.frame_fields[1]["ProbeToTrackerTransformStatus"] == "OK"


def test_colour_and_four_sizes(tmp_path: Path, plus_files: SimpleNamespace) -> None:
    stored = plus_files.speckle(2, 5, 21).reshape(2, 5, 7, 3)
    np.testing.assert_array_equal(read_nrrd(plus_files.write_nrrd(tmp_path / "c.nrrd", stored, {})).pixels, stored)
    volumes = {"sizes": "7 5 1 2", "kinds": "domain domain domain list"}
    grey = plus_files.speckle(2, 5, 7)
    np.testing.assert_array_equal(
        read_nrrd(plus_files.write_nrrd(tmp_path / "v.nrrd", grey, {}, **volumes)).pixels, grey
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"type": "float"}, "uchar, ushort or short, got type float"),
        ({"encoding": "bzip2"}, "raw or gzip, got bzip2"),
        ({"sizes": "7 5"}, "columns x rows x frames"),
        ({"sizes": "7 5 x"}, "sizes must be whole numbers"),
        ({"sizes": "7 5 4"}, "truncated"),
        ({"sizes": "1 1 4000000000"}, "says 4000000000 frames, but has fields of 0 only"),
        ({"sizes": "7 5 2"}, "more pixels"),
        ({"byte skip": "-1"}, "byte skip"),
        ({"byte skip": "4"}, "a byte skip of compressed pixels"),
        ({"kinds": "list domain list"}, "one axis must be that of the frames, got kinds 'list domain list'"),
        ({"sizes": "0 0 93"}, "it holds no images: a recording of the tracker alone"),
    ],
)
def test_headers_that_cannot_be_are_refused(
    tmp_path: Path, plus_files: SimpleNamespace, changes: dict[str, str], message: str
) -> None:
    path = plus_files.write_nrrd(tmp_path / "s.nrrd", plus_files.speckle(3, 5, 7), {}, **changes)
    with pytest.raises(DatasetInvalid, match=rf"s\.nrrd: .*{message}"):
        read_nrrd(path)


@pytest.mark.parametrize("content", [b"", b"NRRD0004\nno colon\n\n", b"PNG\n", b"NRRD0004\n\n"])
def test_foreign_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "s.nrrd"
    path.write_bytes(content)
    with pytest.raises(DatasetInvalid, match=r"s\.nrrd: (not an NRRD file|pixels must|sizes must)"):
        read_nrrd(path)

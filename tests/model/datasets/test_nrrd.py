"""NRRD sequences, as PLUS and 3D Slicer write them."""

import numpy as np
import pytest
import SimpleITK

from ultragray.datasets.plus_files import read_nrrd
from ultragray.errors import DatasetInvalid


@pytest.mark.parametrize(
    "changes",
    [{}, {"encoding": "raw"}, {"encoding": "gz"}, {"data file": "s.raw", "encoding": "raw"}, {"data file": "s.raw.gz"}],
)
def test_pixels_and_fields(tmp_path, plus_files, changes):
    stored = plus_files.speckle(3, 5, 7)
    fields = {"ultrasound image orientation": "MN", **plus_files.tracked_fields(3)}
    sequence = read_nrrd(plus_files.write_nrrd(tmp_path / "s.seq.nrrd", stored, fields, **changes))
    np.testing.assert_array_equal(sequence.pixels, stored)
    assert sequence.fields == {"ultrasound image orientation": "MN"}
    assert sequence.frame_fields[1]["ProbeToTrackerTransformStatus"] == "OK"


def test_colour_and_four_sizes(tmp_path, plus_files):
    stored = plus_files.speckle(2, 5, 21).reshape(2, 5, 7, 3)
    np.testing.assert_array_equal(read_nrrd(plus_files.write_nrrd(tmp_path / "c.nrrd", stored, {})).pixels, stored)
    volumes = {"sizes": "7 5 1 2", "kinds": "domain domain domain list"}
    grey = plus_files.speckle(2, 5, 7)
    np.testing.assert_array_equal(
        read_nrrd(plus_files.write_nrrd(tmp_path / "v.nrrd", grey, {}, **volumes)).pixels, grey
    )


@pytest.mark.parametrize(
    ("order", "changes"),
    [
        ((1, 2, 0), {"kinds": "list domain domain", "sizes": "3 7 5"}),
        ((1, 2, 0), {"kinds": "list domain domain domain", "sizes": "3 7 5 1", "dimension": "4"}),
        ((1, 2, 0), {"kinds": "??? ??? ???", "sizes": "3 7 5"}),
        ((1, 2, 0), {"kinds": "", "sizes": "3 7 5"}),
        ((1, 2, 0), {"kinds": "", "sizes": "3 7 5", "space directions": "none (1,0,0) (0,1,0)"}),
        ((0, 1, 2), {"kinds": "domain domain list", "sizes": "7 5 3"}),
        ((0, 1, 2), {"kinds": "domain domain domain list", "sizes": "7 5 1 3", "dimension": "4"}),
        ((0, 1, 2), {"kinds": "space space time", "sizes": "7 5 3"}),
        ((1, 0, 2), {"kinds": "domain list domain", "sizes": "7 3 5"}),
        ((1, 2, 0), {"kinds": "vector domain domain", "sizes": "12 7 5"}),
    ],
    ids=lambda value: " ".join(value.values()) if isinstance(value, dict) else None,
)
def test_the_axis_of_the_frames_is_found_wherever_it_is(tmp_path, plus_files, order, changes):
    """3D Slicer writes the list first; `order` is that of frames, rows and columns in the file, the slowest first."""
    count = 12 if "12" in changes["sizes"] else 3
    stored = plus_files.speckle(count, 5, 7)
    in_file = np.ascontiguousarray(stored.transpose(order))
    fields = plus_files.tracked_fields(count)
    path = plus_files.write_nrrd(tmp_path / "s.seq.nrrd", in_file.reshape(count, 5, 7), fields, **changes)
    np.testing.assert_array_equal(read_nrrd(path).pixels, stored)


def test_frames_in_colour_between_other_axes(tmp_path, plus_files):
    stored = plus_files.speckle(2, 5, 21).reshape(2, 5, 7, 3)
    changes = {"kinds": "RGB-color list domain domain", "sizes": "3 2 7 5"}
    in_file = np.ascontiguousarray(stored.transpose(1, 2, 0, 3)).reshape(stored.shape)
    path = plus_files.write_nrrd(tmp_path / "c.nrrd", in_file, {}, **changes)
    np.testing.assert_array_equal(read_nrrd(path).pixels, stored)


def test_sequences_agree_with_another_reader(tmp_path, plus_files):
    for name, changes in (
        ("a.nrrd", {"kinds": "domain domain list"}),
        ("b.nrrd", {"encoding": "raw"}),
        ("c.nhdr", {"data file": "c.raw", "encoding": "raw", "byte skip": "-1"}),
    ):
        path = plus_files.write_nrrd(tmp_path / name, plus_files.speckle(3, 5, 7), {}, **changes)
        expected = SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(str(path)))
        if expected.shape != (3, 5, 7):  # it makes a list the components of pixels
            expected = np.moveaxis(expected, -1, 0)
        np.testing.assert_array_equal(read_nrrd(path).pixels, expected)


def test_a_list_of_files_and_bytes_to_skip(tmp_path, plus_files):
    stored = plus_files.speckle(3, 5, 7)
    for number, frame in enumerate(stored):
        (tmp_path / f"f{number}.raw").write_bytes(b"head" + frame.tobytes())
    header = "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 7 5 3\nencoding: raw\nbyte skip: {}\ndata file: {}\n"
    for skip, files in (("4", "LIST\nf0.raw\nf1.raw\nf2.raw"), ("-1", "f%d.raw 0 2 1")):
        (tmp_path / "s.nhdr").write_text(header.format(skip, files))
        np.testing.assert_array_equal(read_nrrd(tmp_path / "s.nhdr").pixels, stored)


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
def test_headers_that_cannot_be_are_refused(tmp_path, plus_files, changes, message):
    path = plus_files.write_nrrd(tmp_path / "s.nrrd", plus_files.speckle(3, 5, 7), {}, **changes)
    with pytest.raises(DatasetInvalid, match=rf"s\.nrrd: .*{message}"):
        read_nrrd(path)


@pytest.mark.parametrize("content", [b"", b"NRRD0004\nno colon\n\n", b"PNG\n", b"NRRD0004\n\n"])
def test_foreign_files_are_refused(tmp_path, content):
    path = tmp_path / "s.nrrd"
    path.write_bytes(content)
    with pytest.raises(DatasetInvalid, match=r"s\.nrrd: (not an NRRD file|pixels must|sizes must)"):
        read_nrrd(path)

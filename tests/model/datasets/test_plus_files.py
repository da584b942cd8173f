"""MetaImage and NRRD sequences as PLUS and 3D Slicer write them and as they arrive damaged; stored orientations."""

import gzip
import zlib
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import SimpleITK

from ultragray.datasets.plus_files import orient_frames, read_meta_image, read_nrrd
from ultragray.errors import DatasetInvalid


@pytest.mark.parametrize("deflate", [True, False])
@pytest.mark.parametrize("data_file", ["LOCAL", "pixels.raw", "pixels.zraw"])
def test_pixels_and_fields_of_a_meta_image(tmp_path, plus_files, deflate, data_file):
    stored = plus_files.speckle(3, 5, 7)
    fields = {"UltrasoundImageOrientation": "MFA", **plus_files.tracked_fields(4)}  # of one frame more than it has
    path = plus_files.write_mha(tmp_path / "s.mhd", stored, fields, deflate=deflate, data_file=data_file)
    sequence = read_meta_image(path)
    np.testing.assert_array_equal(sequence.pixels, stored)
    assert sequence.fields["UltrasoundImageOrientation"] == "MFA"
    assert len(sequence.frame_fields) == 3
    assert sequence.frame_fields[2]["ProbeToTrackerTransform"].split()[7] == "2.0"
    assert sequence.frame_fields[2]["ProbeToTrackerTransformStatus"] == "OK"


def test_colour_and_four_sizes_of_a_meta_image(tmp_path, plus_files):
    stored = plus_files.speckle(2, 5, 21).reshape(2, 5, 7, 3)
    np.testing.assert_array_equal(read_meta_image(plus_files.write_mha(tmp_path / "c.mha", stored, {})).pixels, stored)
    path = plus_files.write_mha(tmp_path / "v.mha", stored, {"DimSize": "7 5 1 2"})
    np.testing.assert_array_equal(read_meta_image(path).pixels, stored)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ElementType": "MET_FLOAT"}, "MET_UCHAR, MET_UCHAR_ARRAY, MET_USHORT, MET_SHORT, got ElementType MET_FLOAT"),
        ({"BinaryData": "False"}, "must be binary"),
        ({"DimSize": "7 5"}, "columns x rows x frames, got 7 x 5"),
        ({"DimSize": "seven"}, "DimSize must be whole numbers"),
        ({"DimSize": "0 5 3"}, "it holds no images: a recording of the tracker alone, of 3 frames"),
        ({"DimSize": "0 0 93", "ElementType": "MET_OTHER"}, "it holds no images: a recording of the tracker alone"),
        ({"UltrasoundImageType": "RF_REAL"}, "images must be B-mode .* RF_REAL .RF data"),
        ({"DimSize": "7 5 0"}, "it holds no frames"),
        ({"DimSize": "99999 99999 99"}, "the limit is 4 GiB"),
        ({"DimSize": "1 1 4000000000"}, "says 4000000000 frames, but has fields of 2 only"),
        ({"DimSize": "7 5 4"}, "truncated: .* 105 of 140|truncated: 105 bytes .*140"),
        ({"DimSize": "7 5 2"}, "more pixels than the 70 bytes"),
        ({"ElementNumberOfChannels": "2"}, "1, 3 or 4 channels, got 2"),
    ],
)
@pytest.mark.parametrize("deflate", [True, False])
def test_headers_of_a_meta_image_that_cannot_be_are_refused(tmp_path, plus_files, changes, message, deflate):
    fields = plus_files.tracked_fields(2) | changes
    path = plus_files.write_mha(tmp_path / "s.mha", plus_files.speckle(3, 5, 7), fields, deflate=deflate)
    with pytest.raises(DatasetInvalid, match=rf"s\.mha: .*({message})"):
        read_meta_image(path)


@pytest.mark.parametrize("word", ["True", "true", "T", "t", "1"])
def test_booleans_as_metaio_takes_them(tmp_path, plus_files, word):
    stored = plus_files.speckle(3, 5, 7).astype(np.uint16) * 200
    fields = {"ElementType": "MET_USHORT", "BinaryData": word, "CompressedData": word, "BinaryDataByteOrderMSB": word}
    path = plus_files.write_mha(tmp_path / "s.mha", stored.astype(">u2"), fields)
    expected = SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(str(path)))
    np.testing.assert_array_equal(expected, stored)
    np.testing.assert_array_equal(read_meta_image(path).pixels, expected >> 8)
    plain = {**fields, "CompressedData": "False", "BinaryDataByteOrderMSB": "0"}
    path = plus_files.write_mha(tmp_path / "s.mha", stored.astype("<u2"), plain, deflate=False)
    np.testing.assert_array_equal(read_meta_image(path).pixels, stored >> 8)


@pytest.mark.parametrize("is_local", [True, False])
@pytest.mark.parametrize("header_size", ["-1", "exact"])
def test_a_header_before_the_pixels_is_passed_over(tmp_path, plus_files, is_local, header_size):
    stored = plus_files.speckle(3, 5, 7)
    text = (
        "ObjectType = Image\nNDims = 3\nBinaryData = True\nDimSize = 7 5 3\nElementType = MET_UCHAR\nHeaderSize = {}\n"
    )
    text += f"ElementDataFile = {'LOCAL' if is_local else 's.raw'}\n"
    before = b"another header of some length"
    size = len(before) + (len(text.format("000")) if is_local else 0)
    text = text.format("-1" if header_size == "-1" else size)
    path = tmp_path / "s.mhd"
    path.write_bytes(text.encode() + (before + stored.tobytes() if is_local else b""))
    (tmp_path / "s.raw").write_bytes(before + stored.tobytes())
    if not is_local or header_size != "-1":
        np.testing.assert_array_equal(SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(str(path))), stored)
    np.testing.assert_array_equal(read_meta_image(path).pixels, stored)


@pytest.mark.parametrize("files", ["LIST\nf1.raw\nf2.raw\nf3.raw", "f%d.raw 1 3 1", "f%01d.raw 1 3"])
def test_pixels_in_a_file_a_frame(tmp_path, plus_files, files):
    stored = plus_files.speckle(3, 5, 7)
    for number, frame in enumerate(stored):
        (tmp_path / f"f{number + 1}.raw").write_bytes(frame.tobytes())
    path = tmp_path / "s.mhd"
    path.write_text(
        "ObjectType = Image\nNDims = 3\nDimSize = 7 5 3\nElementType = MET_UCHAR\nElementDataFile = " + files + "\n"
    )
    np.testing.assert_array_equal(read_meta_image(path).pixels, stored)
    if files != "f%01d.raw 1 3":
        np.testing.assert_array_equal(SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(str(path))), stored)
    (tmp_path / "f2.raw").unlink()
    with pytest.raises(DatasetInvalid, match=r"'f2\.raw' with its pixels was not found beside it"):
        read_meta_image(path)


def test_16_bits_below_zero_are_told_to_be_rf(tmp_path, plus_files):
    stored = (plus_files.speckle(3, 5, 7).astype(np.int16) - 120).astype("<i2")
    path = plus_files.write_mha(tmp_path / "s.mha", stored, {"ElementType": "MET_SHORT"})
    with pytest.raises(DatasetInvalid, match=r"the smallest is -120: RF data, not B-mode\?"):
        read_meta_image(path)


@pytest.mark.parametrize("data_file", ["../pixels.raw", "/etc/hosts", "missing.raw"])
def test_pixels_lie_beside_the_header(tmp_path, plus_files, data_file):
    path = plus_files.write_mha(tmp_path / "s.mhd", plus_files.speckle(3, 5, 7), {}, data_file="pixels.raw")
    path.write_bytes(path.read_bytes().replace(b"pixels.raw", data_file.encode()))
    with pytest.raises(DatasetInvalid, match=r"s\.mhd: .*beside it"):
        read_meta_image(path)


@pytest.mark.parametrize("keep", [0, 10, 200, -20, -1])
def test_truncated_files_are_refused(tmp_path, plus_files, keep):
    path = plus_files.write_mha(tmp_path / "s.mha", plus_files.speckle(3, 50, 70), {})
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(DatasetInvalid, match=r"s\.mha: (truncated|not a MetaImage file)"):
        read_meta_image(path)


def test_damaged_and_foreign_files_are_refused(tmp_path, plus_files):
    path = plus_files.write_mha(tmp_path / "s.mha", plus_files.speckle(3, 50, 70), {})
    data = bytearray(path.read_bytes())
    data[-3000] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(DatasetInvalid, match=r"s\.mha: its compressed pixels are damaged"):
        read_meta_image(path)
    for content in (b"\x93NUMPY\0\0", b"hello\n" * 3, b"a" * (2 << 20)):
        path.write_bytes(content)
        with pytest.raises(DatasetInvalid, match=r"s\.mha: not a"):
            read_meta_image(path)


def test_a_bomb_is_not_inflated(tmp_path, plus_files, monkeypatch):
    path = plus_files.write_mha(tmp_path / "s.mha", np.zeros((3, 2000, 1000), np.uint8), {"DimSize": "7 5 3"})
    inflated = []
    make = zlib.decompressobj

    class Watched:
        def __init__(self, bits):
            self.inner = make(bits)

        def decompress(self, data, limit):
            inflated.append(len(pixels := self.inner.decompress(data, limit)))
            return pixels

        @property
        def eof(self):
            return self.inner.eof

    monkeypatch.setattr(zlib, "decompressobj", Watched)
    with pytest.raises(DatasetInvalid, match="more pixels than the 105 bytes"):
        read_meta_image(path)
    assert sum(inflated) <= 106


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
    lists = "LIST\nf0.raw\nf1.raw\nf2.raw", "LIST 2\nf0.raw\nf1.raw\nf2.raw", "f%d.raw 0 2 1", "f%d.raw 0 2 1 2"
    for skip, files in product(("4", "-1", "3\nline skip: 2"), lists):
        for number, frame in enumerate(stored):
            head = b"a line\nand another\n\r\0x" if "line" in skip else b"head"
            (tmp_path / f"f{number}.raw").write_bytes(head + frame.tobytes())
        (tmp_path / "s.nhdr").write_text(header.format(skip, files))
        np.testing.assert_array_equal(read_nrrd(tmp_path / "s.nhdr").pixels, stored)
    (tmp_path / "s.nhdr").write_text(header.format("0\nline skip: 20000", lists[0]))
    with pytest.raises(DatasetInvalid, match="over 10000 skipped lines"):
        read_nrrd(tmp_path / "s.nhdr")
    (tmp_path / "s.nhdr").write_text(header.format("0\nline skip: 90", lists[0]))
    with pytest.raises(DatasetInvalid, match="does not begin with 90 lines"):
        read_nrrd(tmp_path / "s.nhdr")


def test_several_members_of_gzip_are_one_picture(tmp_path, plus_files):
    stored = plus_files.speckle(3, 5, 7)
    path, data = plus_files.write_nrrd(tmp_path / "s.nrrd", stored, {}, encoding="raw"), stored.tobytes()
    header = path.read_bytes().removesuffix(data).replace(b"encoding: raw", b"encoding: gzip")
    members = [gzip.compress(data[:40]), gzip.compress(data[40:41]), gzip.compress(data[41:])]
    for rest in (b"", b"\0\0"):
        path.write_bytes(header + b"".join(members) + rest)
        np.testing.assert_array_equal(read_nrrd(path).pixels, stored)
    path.write_bytes(header + b"".join([*members, gzip.compress(b"more")]))
    with pytest.raises(DatasetInvalid, match="more pixels than the 105 bytes"):
        read_nrrd(path)
    path.write_bytes(header + members[0] + members[1])
    with pytest.raises(DatasetInvalid, match="truncated: 41 bytes of pixels"):
        read_nrrd(path)


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


MF = np.arange(12, dtype=np.uint8).reshape(1, 3, 4)  # rows: depth, columns: towards the marked side


@pytest.mark.parametrize(
    ("orientation", "stored"),
    [
        ("MF", MF),
        ("MFD", MF),
        ("", MF),
        ("UF", MF[:, :, ::-1]),
        ("MN", MF[:, ::-1]),
        ("UN", MF[:, ::-1, ::-1]),
        ("FM", MF.transpose(0, 2, 1)),
        ("NM", MF.transpose(0, 2, 1)[:, :, ::-1]),  # columns go towards the transducer
        ("FU", MF.transpose(0, 2, 1)[:, ::-1]),
        ("NU", MF.transpose(0, 2, 1)[:, ::-1, ::-1]),
    ],
)
def test_every_orientation_becomes_mf(orientation, stored):
    np.testing.assert_array_equal(orient_frames(stored, orientation, Path("s.mha")), MF)


@pytest.mark.parametrize("orientation", ["AMF", "MM", "FN", "M", "MFX", "mf?"])
def test_orientations_that_no_image_has_are_refused(orientation):
    with pytest.raises(DatasetInvalid, match=r"s\.mha: UltrasoundImageOrientation must be"):
        orient_frames(MF, orientation, Path("s.mha"))

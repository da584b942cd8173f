"""MetaImage sequences, as PLUS writes them and as they arrive damaged."""

import zlib

import numpy as np
import pytest
import SimpleITK

from ultragray.datasets.plus_files import read_meta_image
from ultragray.errors import DatasetInvalid


@pytest.mark.parametrize("deflate", [True, False])
@pytest.mark.parametrize("data_file", ["LOCAL", "pixels.raw", "pixels.zraw"])
def test_pixels_and_fields(tmp_path, plus_files, deflate, data_file):
    stored = plus_files.speckle(3, 5, 7)
    fields = {"UltrasoundImageOrientation": "MFA", **plus_files.tracked_fields(4)}  # of one frame more than it has
    path = plus_files.write_mha(tmp_path / "s.mhd", stored, fields, deflate=deflate, data_file=data_file)
    sequence = read_meta_image(path)
    np.testing.assert_array_equal(sequence.pixels, stored)
    assert sequence.fields["UltrasoundImageOrientation"] == "MFA"
    assert len(sequence.frame_fields) == 3
    assert sequence.frame_fields[2]["ProbeToTrackerTransform"].split()[7] == "2.0"
    assert sequence.frame_fields[2]["ProbeToTrackerTransformStatus"] == "OK"


def test_colour_and_four_sizes(tmp_path, plus_files):
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
        ({"DimSize": "7 5 4 3"}, "columns x rows x frames"),
        ({"DimSize": "seven"}, "DimSize must be whole numbers"),
        ({"DimSize": "-7 5 3"}, "DimSize must be whole numbers"),
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
def test_headers_that_cannot_be_are_refused(tmp_path, plus_files, changes, message, deflate):
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

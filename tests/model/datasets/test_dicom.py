"""DICOM cine loops with poses beside them, in files that pydicom writes."""

import json
import sys
from functools import partial

import cv2
import numpy as np
import pytest
from pydicom.encaps import encapsulate
from pydicom.pixels.decoders.base import Decoder
from pydicom.uid import UID, DeflatedExplicitVRLittleEndian, JPEGBaseline8Bit, JPEGLosslessSV1

from ultragray import ConvexProbe, LinearProbe
from ultragray.datasets import dicom
from ultragray.datasets.source import SourceOptions, load_dataset
from ultragray.errors import DatasetInvalid, ExtraMissing, InvalidArgument
from ultragray.geometry.scan_conversion import scan_convert

from ...dicom_files import FRAMES, POSES, region, write_cine


@pytest.fixture
def write(tmp_path):
    return partial(write_cine, tmp_path)


def test_a_cine_loop_is_the_region_with_its_poses(write):
    dataset = load_dataset(write())
    assert (dataset.name, dataset.probe) == ("sweep", LinearProbe(10.0, 0.0, 5.0))
    assert dataset.val.frame_numbers.tolist() == [2, 7]
    np.testing.assert_array_equal(dataset.val.images, FRAMES[[2, 7], 2:22, 4:24])
    np.testing.assert_allclose(dataset.val.poses, POSES[[2, 7]], atol=1e-12)
    assert not dataset.train.notes


def test_a_crop_moves_the_origin_to_its_own_top_centre(write):
    dataset = load_dataset(write(), SourceOptions(crop="4:14,6:22", frames="0:6", val_frames="3", image_size="5x8"))
    assert dataset.probe == LinearProbe(5.0, 0.0, 4.0)
    assert dataset.train.frame_numbers.tolist() == [0, 1, 2, 4, 5]
    assert dataset.train.images.shape == (5, 8, 5)
    centre = np.array([-2.5, 0.0, 1.0, 1.0])  # mm, from the top centre of the region
    np.testing.assert_allclose(dataset.val.poses[0, :, 3], POSES[3] @ centre, atol=1e-12)


def test_poses_in_json_and_a_scale_without_regions(write, tmp_path):
    path = write(SequenceOfUltrasoundRegions=None, PixelSpacing=[0.2, 0.4], TransducerType=None, poses=None)
    (tmp_path / "sweep.poses.json").write_text(json.dumps(POSES[:, :3].tolist()))
    dataset = load_dataset(path)
    assert dataset.probe == LinearProbe(12.8, 0.0, 4.8)
    assert dataset.train.notes == (
        "no region in centimetres: the whole image of 32 x 24 pixels is taken as ultrasound",
        "the file does not name its transducer: taken as a linear one",
    )


def test_the_fan_of_a_convex_probe_becomes_scan_lines(write):
    """What a scanner would store of a known image in range and angle comes back, with the poses as they are."""
    probe, pixel_mm = ConvexProbe(opening_angle_deg=50.0, near_mm=10.0, far_mm=30.0), 0.1
    rows, lines = np.meshgrid(np.linspace(0.2, 0.9, 200), np.linspace(0.3, 1.0, 160), indexing="ij")
    truth = (rows * lines).astype(np.float32)
    screen = np.rint(255 * scan_convert(truth, probe, pixel_mm)).astype(np.uint8)
    height, width = screen.shape
    picture = probe.picture(pixel_mm)
    apex = (-picture.first[0] / pixel_mm, -picture.first[1] / pixel_mm)
    path = write(
        TransducerType="CURVED LINEAR",
        Rows=height,
        Columns=width,
        SequenceOfUltrasoundRegions=None,
        PixelSpacing=[pixel_mm, pixel_mm],
        data=np.stack([screen] * len(FRAMES)).tobytes(),
    )
    options = SourceOptions(fan=f"50,10,30,{apex[0]!r},{apex[1]!r}")
    dataset = load_dataset(path, options)
    assert dataset.probe == probe
    np.testing.assert_array_equal(dataset.val.poses, POSES[[2, 7]])
    found = dataset.val.images[0] / 255.0
    expected = cv2.resize(truth, found.shape[::-1], interpolation=cv2.INTER_LINEAR)
    inner = np.s_[3:-3, 3:-3]  # at the rim the screen is black beside the fan
    assert np.abs(found - expected)[inner].max() < 0.02
    with pytest.raises(InvalidArgument, match="fan must be given without crop"):
        load_dataset(path, SourceOptions(fan=options.fan, crop="0:9,0:9"))


COMPRESSED = encapsulate([b"\xff\xd8\xff\xd9"] * len(FRAMES))


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"poses": None}, r"must lie beside it in sweep\.poses\.npy or sweep\.poses\.json, found 0"),
        ({"poses": POSES[:7]}, r"sweep\.dcm holds 10 frames, but .*sweep\.poses\.npy 7 poses"),
        ({"poses": POSES * 2.0}, r"sweep\.poses\.npy: frame 0: its pose must end in the row"),
        ({"SamplesPerPixel": 3}, r"with SamplesPerPixel 1 or 3, got MONOCHROME2 with 3"),
        ({"PhotometricInterpretation": "CMYK"}, r"must be MONOCHROME1, MONOCHROME2, PALETTE COLOR, .* got CMYK with 1"),
        ({"BitsStored": [8, 8]}, r"it cannot be read as DICOM"),
        ({"BitsAllocated": 32}, r"pixels must have 8 or 16 bits \(BitsAllocated\) without a sign, got 32"),
        ({"TransducerType": "CURVED LINEAR"}, r"TransducerType is CURVED LINEAR: say with fan"),
        ({"NumberOfFrames": None}, r"it lacks NumberOfFrames"),
        ({"NumberOfFrames": 2_000_000_000}, r"its header says 2000000000 x 24 x 32"),
        (
            {"NumberOfFrames": 11, "poses": np.concatenate([POSES, POSES[:1]])},
            r"sweep\.dcm: frame 10: it cannot be read",
        ),
        ({"SequenceOfUltrasoundRegions": None}, r"does not say how large a pixel is"),
        (
            {"SequenceOfUltrasoundRegions": [region(), region(PhysicalDeltaX=0.04)]},
            r"several regions .*: 4:24,2:22 \(pixels of 0\.5 x 0\.25 mm\); 4:24,2:22 \(pixels of 0\.4 x 0\.25 mm\)",
        ),
        (
            {"SequenceOfUltrasoundRegions": [region(PhysicalDeltaY=0.0)]},
            r"SequenceOfUltrasoundRegions makes a pixel 0\.5 x 0 mm",
        ),
        (
            {"SequenceOfUltrasoundRegions": [region(RegionLocationMaxX1=33)]},
            r"columns and rows 4:34,2:22, does not lie within 32 x 24",
        ),
        ({"SequenceOfUltrasoundRegions": None, "PixelSpacing": [0.1]}, r"it cannot be read as DICOM"),
        (
            {"syntax": UID("1.2.840.10008.1.2.4.100"), "data": COMPRESSED},
            r"its pixels are a video \(MPEG2 .*: write its frames as",
        ),
        (
            {"syntax": JPEGBaseline8Bit, "data": COMPRESSED},
            r"sweep\.dcm: (frame 0: it cannot be read|.* need a decoder)",
        ),
        ({"syntax": DeflatedExplicitVRLittleEndian}, r"its data set is deflated"),
        ({"EncapsulatedDocument": b"x" * 200_000}, r"over 0 MiB stand before its pixels"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_what_cannot_be_used_is_one_clear_error(write, values, expected, monkeypatch):
    monkeypatch.setattr(dicom._BoundedFile, "left", 100_000)
    monkeypatch.setattr(dicom, "MAX_HEADER_BYTES", 100_000)
    with pytest.raises(DatasetInvalid, match=expected):
        load_dataset(write(**values))


def test_a_decoder_that_is_not_installed_is_named(write, monkeypatch):
    monkeypatch.setattr(Decoder, "is_available", False)
    with pytest.raises(DatasetInvalid, match=r"compressed as JPEG Lossless.* cannot be read: install python-gdcm"):
        load_dataset(write(syntax=JPEGLosslessSV1, data=COMPRESSED))


def test_a_format_that_no_decoder_of_ours_reads_names_none(write):
    with pytest.raises(
        DatasetInvalid, match=r"High-Throughput JPEG 2000 .* cannot be read: save the file without comp"
    ):
        load_dataset(write(syntax=UID("1.2.840.10008.1.2.4.201"), data=COMPRESSED))


def test_files_that_are_no_dicom(tmp_path, write):
    whole = write().read_bytes()
    for name, content in (("text.dcm", b"no DICOM"), ("empty.dcm", b""), ("cut.dcm", whole[:300])):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DatasetInvalid, match=name):
            load_dataset(tmp_path / name)
    (tmp_path / "sweep.dcm").write_bytes(whole[:-500])
    with pytest.raises(DatasetInvalid, match=r"sweep\.dcm: "):
        load_dataset(tmp_path / "sweep.dcm")


def test_a_value_of_a_kind_that_does_not_exist(write, tmp_path):
    whole = write().read_bytes()
    photometric_interpretation = b"\x28\x00\x04\x00"
    (tmp_path / "sweep.dcm").write_bytes(
        whole.replace(photometric_interpretation + b"CS", photometric_interpretation + b"BS")
    )
    with pytest.raises(DatasetInvalid, match=r"sweep\.dcm: it cannot be read as DICOM"):
        load_dataset(tmp_path / "sweep.dcm")


@pytest.mark.parametrize("tag", [b"\x28\x00\x03\x01", b"\x28\x00\x00\x01", b"\x28\x00\x02\x00"])
def test_a_header_with_a_damaged_kind_of_value_is_one_clear_error(write, tag):
    """PixelRepresentation, BitsAllocated or SamplesPerPixel, whose value representation is none."""
    path = write()
    data = path.read_bytes()
    assert data.count(tag + b"US") == 1
    path.write_bytes(data.replace(tag + b"US", tag + b"UQ"))
    with pytest.raises(DatasetInvalid, match="cannot be read as DICOM: Unknown Value Representation 'UQ'"):
        load_dataset(path)


def test_options_of_other_formats_are_refused(write, tmp_path):
    with pytest.raises(InvalidArgument, match=r"device_set is for PLUS sequences, sweep\.dcm is none"):
        load_dataset(write(), SourceOptions(device_set=tmp_path / "set.xml"))
    with pytest.raises(InvalidArgument, match=r"crop must lie within columns 0:32 and rows 0:24"):
        load_dataset(write(), SourceOptions(crop="0:99,0:9"))


def test_without_pydicom_the_extra_is_named(write, monkeypatch):
    path = write()
    monkeypatch.setitem(sys.modules, "pydicom", None)
    with pytest.raises(ExtraMissing, match=r"ultragray\[dicom\]"):
        load_dataset(path)

"""The DICOM file, checked against the attributes that PS3.3 requires of an Ultrasound Multi-frame Image (A.7)."""

import base64
import dataclasses
import io
import json
import shutil
import struct
import subprocess
import zlib
from datetime import datetime, timezone

import numpy as np
import pydicom
import pytest
from PIL import Image
from pydicom.uid import ExplicitVRLittleEndian, UltrasoundImageStorage, UltrasoundMultiFrameImageStorage

from ultragray import ConvexProbe, LinearProbe, PhasedProbe
from ultragray.datasets.source import SourceOptions, load_dataset
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.exchange.exports import export_to
from ultragray.exchange.exports.exporter import Annotation
from ultragray.geometry.scan_conversion import scan_convert
from ultragray.rendering.settings import Resolved
from ultragray.scene.confidence import Extrapolation

from .conftest import POSES, exported, header_of

LINEAR = LinearProbe(width_mm=38.0, near_mm=2.0, far_mm=52.0)
CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=20.0, far_mm=60.0)
FRAMES = np.random.default_rng(0).random((5, 21, 19), np.float32)
TOLD = [Extrapolation(0.5 * number, 2.0, None, 0.25) for number in range(5)]

FILLED = {  # type 1, and 1C whose condition holds
    "Patient": ("DeidentificationMethod",),
    "General Study": ("StudyInstanceUID",),
    "General Series": ("Modality", "SeriesInstanceUID"),
    "Image Pixel": (
        "SamplesPerPixel",
        "PhotometricInterpretation",
        "Rows",
        "Columns",
        "BitsAllocated",
        "BitsStored",
        "HighBit",
        "PixelRepresentation",
        "PixelData",
    ),
    "Cine": ("FrameTime",),
    "Multi-frame": ("NumberOfFrames", "FrameIncrementPointer"),
    "US Image": ("ImageType", "LossyImageCompression"),
    "SOP Common": ("SOPClassUID", "SOPInstanceUID", "SpecificCharacterSet"),
    "US Region Calibration": ("SequenceOfUltrasoundRegions",),
}
PRESENT = {  # type 2, and 2C whose condition holds
    "Patient": ("PatientName", "PatientID", "PatientBirthDate", "PatientSex"),
    "General Study": ("StudyDate", "StudyTime", "ReferringPhysicianName", "StudyID", "AccessionNumber"),
    "General Series": ("SeriesNumber", "Laterality"),
    "General Equipment": ("Manufacturer",),
    "General Image": ("InstanceNumber", "PatientOrientation"),
}
OF_A_REGION = (
    "RegionSpatialFormat",
    "RegionDataType",
    "RegionFlags",
    "RegionLocationMinX0",
    "RegionLocationMinY0",
    "RegionLocationMaxX1",
    "RegionLocationMaxY1",
    "PhysicalUnitsXDirection",
    "PhysicalUnitsYDirection",
    "PhysicalDeltaX",
    "PhysicalDeltaY",
)


@pytest.fixture(autouse=True)
def strict_reading(monkeypatch):
    before = pydicom.config.settings.reading_validation_mode
    pydicom.config.settings.reading_validation_mode = pydicom.config.RAISE
    yield
    pydicom.config.settings.reading_validation_mode = before


def header(probe=LINEAR, **changes):
    return header_of("dicom", Resolved(probe=probe, height=21, width=19), **changes)


def written(path, header):
    count = len(header.poses)
    exported(path, "dicom", header, {"bmode": FRAMES[:count]}, TOLD[:count])
    data = pydicom.dcmread(path)
    for _ in data.iterall():  # reads and checks every value
        pass
    return data


@pytest.mark.parametrize("probe", [LINEAR, CONVEX])
def test_all_that_the_standard_requires_is_there(tmp_path, probe):
    data = written(tmp_path / "frames.dcm", header(probe=probe))
    assert data.file_meta.MediaStorageSOPClassUID == data.SOPClassUID == UltrasoundMultiFrameImageStorage
    assert data.file_meta.MediaStorageSOPInstanceUID == data.SOPInstanceUID
    assert data.file_meta.TransferSyntaxUID == ExplicitVRLittleEndian
    missing = [
        (module, name)
        for module, names in FILLED.items()
        for name in names
        if data.get(name) is None or data[name].VM == 0
    ]
    missing += [(module, name) for module, names in PRESENT.items() for name in names if name not in data]
    assert missing == []
    tags = [element.tag for element in data]
    assert tags == sorted(tags)

    assert (data.Modality, data.PatientIdentityRemoved) == ("US", "YES")
    assert (data.SamplesPerPixel, data.PhotometricInterpretation, data.PixelRepresentation) == (1, "MONOCHROME2", 0)
    assert (data.BitsAllocated, data.BitsStored, data.HighBit) == (8, 8, 7)
    assert data.ImageType[0] in ("ORIGINAL", "DERIVED")
    assert data.ImageType[1] in ("PRIMARY", "SECONDARY")
    assert data.FrameIncrementPointer == pydicom.datadict.tag_for_keyword("FrameTime")
    assert (data.NumberOfFrames, float(data.FrameTime)) == (5, 40.0)
    assert data.BurnedInAnnotation == "NO"
    [region] = data.SequenceOfUltrasoundRegions
    assert [name for name in OF_A_REGION if region.get(name) is None] == []
    assert (region.RegionSpatialFormat, region.RegionDataType) == (1, 1)
    assert (region.PhysicalUnitsXDirection, region.PhysicalUnitsYDirection) == (3, 3)  # cm
    assert (region.RegionLocationMinX0, region.RegionLocationMinY0) == (0, 0)
    assert (region.RegionLocationMaxX1, region.RegionLocationMaxY1) == (data.Columns - 1, data.Rows - 1)
    for uid in (data.SOPInstanceUID, data.SeriesInstanceUID, data.StudyInstanceUID):
        assert uid.is_valid
        assert uid.startswith("2.25.")
        assert len(uid) <= 64


@pytest.mark.parametrize("probe", [LINEAR, CONVEX, PhasedProbe(opening_angle_deg=80.0, far_mm=60.0)])
def test_a_file_read_again_is_its_own_probe_with_its_own_poses(tmp_path, probe):
    """Also below a band of annotations, and with other poses beside it."""
    path = tmp_path / "frames.dcm"
    poses = np.array(POSES)
    poses[:, :3, :3], poses[:, :3, 3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], POSES[:, :3, 3] + 40.0
    mark = Annotation(frame=2, picture=drawn(40, 19, np.s_[30:]))
    data = written(path, dataclasses.replace(header(probe=probe, poses=poses), annotations=(mark,)))
    assert data.TransducerType == {"linear": "LINEAR", "convex": "CURVED LINEAR", "phased": "SECTOR_PHASED"}[probe.kind]
    np.save(tmp_path / "frames.poses.npy", POSES)
    train = load_dataset(path, SourceOptions(val_frames="0")).train
    assert train.probe == probe
    np.testing.assert_array_equal(train.poses, poses[1:])
    assert train.notes == (
        "frames.poses.npy beside the file is not read: it holds its poses itself",
        "annotations are burnt into its pixels (BurnedInAnnotation YES)",
    )
    assert train.times_s is None  # rendered frames have none
    if probe is LINEAR:
        np.testing.assert_array_equal(train.images[2], np.rint(FRAMES[3] * 255))
    with pytest.raises(InvalidArgument, match=r"fan is not for frames\.dcm: it says its .* probe"):
        load_dataset(path, SourceOptions(fan="60,20,60,1,1"))


def test_what_is_left_of_a_damaged_export_is_one_clear_error(tmp_path):
    path = tmp_path / "frames.dcm"
    data = written(path, header(probe=CONVEX))
    data.private_block(0x0019, "ULTRAGRAY")[0x01].value = POSES[:4].tobytes()
    data.save_as(path)
    with pytest.raises(DatasetInvalid, match=r"poses of 5 frames must have 640 bytes, .* has 512"):
        load_dataset(path)
    data.private_block(0x0019, "ULTRAGRAY")[0x03].value = "{}"
    data.save_as(path)
    with pytest.raises(DatasetInvalid, match=r"it cannot be read as DICOM"):
        load_dataset(path)


def position_cm(region, column, row):
    """Lateral and depth of a pixel, as C.8.5.5.1.4 has it."""
    x = region.ReferencePixelPhysicalValueX + (column - region.ReferencePixelX0) * region.PhysicalDeltaX
    y = region.ReferencePixelPhysicalValueY + (row - region.ReferencePixelY0) * region.PhysicalDeltaY
    return x, y


def test_pixels_and_their_places_of_a_linear_probe(tmp_path):
    data = written(tmp_path / "frames.dcm", header())
    np.testing.assert_array_equal(data.pixel_array, np.rint(FRAMES * 255))
    [region] = data.SequenceOfUltrasoundRegions
    assert (region.PhysicalDeltaX, region.PhysicalDeltaY) == pytest.approx((0.2, 5.0 / 21))
    assert position_cm(region, 0, 0) == pytest.approx((-1.8, 0.2 + 2.5 / 21))
    assert position_cm(region, 18, 20) == pytest.approx((1.8, 5.2 - 2.5 / 21))
    vertical, horizontal = data.PixelAspectRatio
    assert vertical / horizontal == pytest.approx((50 / 21) / 2.0, rel=1e-6)
    assert (tmp_path / "frames.dcm").stat().st_size % 2 == 0


def test_pixels_and_their_places_of_a_convex_probe(tmp_path):
    data = written(tmp_path / "frames.dcm", header(probe=CONVEX))
    [region] = data.SequenceOfUltrasoundRegions
    pixel_cm = 4.0 / 21
    assert (region.PhysicalDeltaX, region.PhysicalDeltaY) == pytest.approx((pixel_cm, pixel_cm))
    assert "PixelAspectRatio" not in data
    bytes_ = np.rint(FRAMES[2] * 255)
    fan = np.rint(scan_convert(bytes_, CONVEX, 10 * pixel_cm))
    np.testing.assert_allclose(data.pixel_array[2], fan, atol=1)
    inside = scan_convert(np.ones((21, 19)), CONVEX, 10 * pixel_cm) > 0
    for row, column in zip(*np.nonzero(inside), strict=True):
        x, z = position_cm(region, int(column), int(row))
        assert 2.0 <= np.hypot(x, z) <= 6.0
        assert abs(np.degrees(np.arctan2(x, z))) <= 30.0
    assert (data.pixel_array[2][~inside] == 0).all()


MADE = datetime(2026, 3, 4, 15, 6, 7, tzinfo=timezone.utc)


def test_one_frame_is_an_ultrasound_image_without_frame_times(tmp_path):
    data = written(tmp_path / "frame.dcm", header(poses=POSES[:1]))
    assert data.file_meta.MediaStorageSOPClassUID == data.SOPClassUID == UltrasoundImageStorage
    for name in ("NumberOfFrames", "FrameTime", "FrameTimeVector", "FrameIncrementPointer"):
        assert name not in data
    np.testing.assert_array_equal(data.pixel_array, np.rint(FRAMES[0] * 255))


def test_the_date_is_when_the_file_was_made_in_utc(tmp_path):
    data = written(tmp_path / "frames.dcm", dataclasses.replace(header(), made_at=MADE))
    assert data.StudyDate == data.SeriesDate == data.AcquisitionDate == data.ContentDate == "20260304"
    assert data.AcquisitionTime == data.ContentTime == data.SeriesTime == "150607.000000"
    assert data.TimezoneOffsetFromUTC == "+0000"


def test_frames_have_the_times_at_which_they_were_seen(tmp_path):
    times = (1000.0, 1033.3, 1100.0, 1140.5, 1200.0)
    data = written(tmp_path / "frames.dcm", dataclasses.replace(header(), frame_times_ms=times))
    assert data.FrameIncrementPointer == pydicom.datadict.tag_for_keyword("FrameTimeVector")
    assert [float(way) for way in data.FrameTimeVector] == pytest.approx([0.0, 33.3, 66.7, 40.5, 59.5])
    assert data.RecommendedDisplayFrameRate == 20
    assert "FrameTime" not in data


def drawn(height, width, shows):
    """A PNG file in base64, white and opaque where `shows`."""
    pixels = np.zeros((height, width, 2), np.uint8)
    pixels[shows] = 255
    file = io.BytesIO()
    Image.fromarray(pixels, "LA").save(file, "PNG")
    return base64.b64encode(file.getvalue()).decode()


def test_annotations_are_burnt_into_their_frames_and_told(tmp_path):
    """One as fine as the frame, whose pixels are 2 mm wide and 50/21 mm high, and five of its rows below."""
    below = round(5 * (50 / 21) / 2.0)
    shows = np.zeros((25 + below, 19), bool)
    shows[:, 4] = True
    one = Annotation(frame=2, picture=drawn(*shows.shape, shows), text="A  12.3 mm\0\x1b × 8 mm")
    asked = dataclasses.replace(header(), annotations=(one,), made_at=MADE)
    data = written(tmp_path / "frames.dcm", asked)
    assert data.BurnedInAnnotation == "YES"
    assert data.ImageComments == "A  12.3 mm × 8 mm"
    plain, pixels = np.rint(FRAMES * 255), data.pixel_array
    assert pixels.shape == (5, 26, 19)
    assert (pixels[2, :, 4] == 255).all()
    others = np.arange(19) != 4
    np.testing.assert_array_equal(pixels[2, :21][:, others], plain[2][:, others])
    np.testing.assert_array_equal(pixels[[0, 1, 3, 4], :21], plain[[0, 1, 3, 4]])
    assert (pixels[:, 21:][..., others] == 0).all()
    [region] = data.SequenceOfUltrasoundRegions
    assert region.RegionLocationMaxY1 == 20  # the band has no depth
    assert data.SOPInstanceUID != written(tmp_path / "x.dcm", dataclasses.replace(asked, annotations=())).SOPInstanceUID


def test_frames_are_enlarged_to_a_finer_annotation_and_stay_where_they_are(tmp_path):
    fine = Annotation(frame=0, picture=drawn(75, 57, np.zeros((75, 57), bool)))
    data = written(tmp_path / "frames.dcm", dataclasses.replace(header(), annotations=(fine,)))
    np.testing.assert_array_equal(data.pixel_array[:, :63], np.rint(FRAMES * 255).repeat(3, 1).repeat(3, 2))
    [region], [plain] = (one.SequenceOfUltrasoundRegions for one in (data, written(tmp_path / "plain.dcm", header())))
    assert (region.RegionLocationMaxX1, region.RegionLocationMaxY1) == (56, 62)
    assert position_cm(region, 3 * 7 + 1, 3 * 9 + 1) == pytest.approx(position_cm(plain, 7, 9))


def png(height, width, chunk=b""):
    """A PNG file in base64 that claims a size, and ends behind a chunk."""

    def packed(data):
        return struct.pack(">I", len(data) - 4) + data + struct.pack(">I", zlib.crc32(data))

    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return base64.b64encode(b"\x89PNG\r\n\x1a\n" + packed(header) + packed(b"zTXt" + chunk) + packed(b"IDAT")).decode()


@pytest.mark.parametrize(
    "picture",
    [
        "",
        "no base64",
        "é",
        base64.b64encode(b"no PNG").decode(),
        drawn(4097, 1, 0),
        png(20_000, 20_000),
        png(9, 9, b"k\0\0" + zlib.compress(bytes(5_000_000))),
    ],
)
def test_an_annotation_that_is_no_picture_is_refused(tmp_path, picture):
    asked = dataclasses.replace(header(), annotations=(Annotation(picture=picture),))
    with pytest.raises(InvalidArgument, match=r"annotations\[0\].picture must") as told:
        written(tmp_path / "frames.dcm", asked)
    assert told.value.field == "annotations[0].picture"


def test_annotations_that_would_make_a_tower_or_fill_the_memory_are_refused(tmp_path):
    for pictures, words in [([drawn(4096, 1, 0)], "4096 rows"), ([drawn(4096, 4096, 0)] * 5, "67,108,864 pixels")]:
        asked = dataclasses.replace(header(), annotations=tuple(Annotation(picture=one) for one in pictures))
        with pytest.raises(InvalidArgument, match=words):
            written(tmp_path / "frames.dcm", asked)


@pytest.mark.skipif(shutil.which("dciodvfy") is None, reason="the validator of Debian's dicom3tools is not installed")
@pytest.mark.parametrize("probe", [LINEAR, CONVEX])
@pytest.mark.parametrize("count", [1, 5])
def test_the_validator_of_dicom3tools_finds_no_error(tmp_path, probe, count):
    mark = Annotation(picture=drawn(57, 57, slice(9, 12)), text="A  12.3 mm")
    for place, more in enumerate(({}, {"annotations": (mark,), "frame_times_ms": [30.0 * i for i in range(count)]})):
        path = tmp_path / f"{place}.dcm"
        written(path, dataclasses.replace(header(probe=probe, poses=POSES[:count]), **more))
        told = subprocess.run(["dciodvfy", path], capture_output=True, text=True, check=False)
        assert "Error" not in told.stderr, told.stderr
        assert told.returncode == 0
        assert ("USImage" if count == 1 else "USMultiFrameImage") in told.stderr


def test_poses_are_in_the_file_and_uids_follow_what_was_rendered_and_when(tmp_path):
    def made(**changes):
        at = changes.pop("made_at", MADE)
        return written(tmp_path / "one.dcm", dataclasses.replace(header(**changes), made_at=at))

    one = made()
    poses = np.frombuffer(one.private_block(0x0019, "ULTRAGRAY")[0x01].value, "<f8").reshape(-1, 4, 4)
    np.testing.assert_array_equal(poses, POSES)
    again = made()
    assert (again.SOPInstanceUID, again.SeriesInstanceUID) == (one.SOPInstanceUID, one.SeriesInstanceUID)
    moved = made(poses=POSES + np.eye(4, k=3))
    assert moved.SOPInstanceUID != one.SOPInstanceUID
    assert moved.StudyInstanceUID == one.StudyInstanceUID
    later = made(made_at=MADE.replace(minute=7))
    assert later.SOPInstanceUID != one.SOPInstanceUID
    assert later.StudyInstanceUID == one.StudyInstanceUID
    assert made(made_at=MADE.replace(day=5)).StudyInstanceUID != one.StudyInstanceUID
    assert made(scene_sha256="1" * 64).StudyInstanceUID != one.StudyInstanceUID
    assert one.SOPInstanceUID != one.SeriesInstanceUID


def test_figures_of_each_frame_are_beside_the_poses(tmp_path):
    data = written(tmp_path / "frames.dcm", header())
    element = data.private_block(0x0019, "ULTRAGRAY")[0x02]
    assert element.VR == "OF"
    figures = np.frombuffer(element.value, "<f4").reshape(-1, 4)
    np.testing.assert_array_equal(figures, [[0.5 * number, 2.0, np.nan, 0.25] for number in range(5)])
    np.testing.assert_array_equal(data.pixel_array, np.rint(FRAMES * 255))


def test_the_origin_is_beside_the_poses(tmp_path):
    asked = header(probe=CONVEX)
    data = written(tmp_path / "frames.dcm", asked)
    origin = json.loads(data.private_block(0x0019, "ULTRAGRAY")[0x03].value)
    assert origin == json.loads(json.dumps(asked.origin()))
    assert origin["display"]["pixel_mm"] == asked.settings.display.pixel_mm


def test_more_than_an_element_holds_is_refused(tmp_path):
    many = np.broadcast_to(np.eye(4), (20_000, 4, 4))
    with (
        pytest.raises(InvalidArgument, match="at most") as caught,
        export_to(
            tmp_path / "frames.dcm",
            "dicom",
            dataclasses.replace(header(), poses=many, settings=Resolved(LINEAR, 512, 512)),
        ),
    ):
        pass
    assert caught.value.field == "format"
    assert list(tmp_path.iterdir()) == []

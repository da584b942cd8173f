"""The DICOM file, checked against the attributes that PS3.3 requires of an Ultrasound Multi-frame Image (A.7)."""

import dataclasses
import json

import numpy as np
import pydicom
import pytest
from pydicom.uid import ExplicitVRLittleEndian, UltrasoundMultiFrameImageStorage

from ultragray import ConvexProbe, LinearProbe
from ultragray.errors import InvalidArgument
from ultragray.exchange.exports import export_to
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
    exported(path, "dicom", header, {"bmode": FRAMES}, TOLD)
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


def test_poses_are_in_the_file_and_uids_follow_what_was_rendered(tmp_path):
    one = written(tmp_path / "one.dcm", header())
    poses = np.frombuffer(one.private_block(0x0019, "ULTRAGRAY")[0x01].value, "<f8").reshape(-1, 4, 4)
    np.testing.assert_array_equal(poses, POSES)
    again = written(tmp_path / "again.dcm", header())
    assert (again.SOPInstanceUID, again.SeriesInstanceUID) == (one.SOPInstanceUID, one.SeriesInstanceUID)
    moved = written(tmp_path / "moved.dcm", header(poses=POSES + np.eye(4, k=3)))
    assert moved.SOPInstanceUID != one.SOPInstanceUID
    assert moved.StudyInstanceUID == one.StudyInstanceUID
    other = written(tmp_path / "other.dcm", header(scene_sha256="1" * 64))
    assert other.StudyInstanceUID != one.StudyInstanceUID
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

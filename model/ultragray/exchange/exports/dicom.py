"""DICOM: Ultrasound Image Storage of one frame (PS3.3 A.6), Ultrasound Multi-frame Image Storage of several (A.7).

8-bit MONOCHROME2, uncompressed. The extra `dicom`. The one item of SequenceOfUltrasoundRegions (C.8.5.5) covers the
frame; its physical values are the probe frame in cm: x lateral, y depth. Frames have the times that the header tells,
else 40 ms each; dates are UTC, when the file was made. Annotations are burnt in, and told by ImageComments. The patient
is the same for every file and no person. The UIDs are 2.25 and a UUID (PS3.5 B.2): that of the study is made of the
scene's hash and the date, those of the series and the image also of the time, the renderer, the probe, the size, the
poses and the annotations. Of the creator ULTRAGRAY are the private elements (0019,1001), OD: the poses [C, 4, 4], mm,
and (0019,1002), OF: the figures [C, 4] of each frame in the order of `confidence.FIGURES` (and a fifth, the share of
contact, where that was asked for), NaN where one is not known, and (0019,1003), UT: the origin as JSON, probe and
display settings included.
"""

from __future__ import annotations

import hashlib
import json
import struct
import uuid
from collections.abc import Mapping
from fractions import Fraction

import numpy as np
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
from pydicom.uid import (
    UID,
    ExplicitVRLittleEndian,
    UltrasoundImageStorage,
    UltrasoundMultiFrameImageStorage,
)

from ultragray.contract import to_dict
from ultragray.errors import InvalidArgument
from ultragray.exchange.exports.burning import AnnotatedPictures
from ultragray.exchange.exports.exporter import FRAME_TIME_MS, Exporter
from ultragray.rendering.pixels import PixelArray

PRIVATE_GROUP, PRIVATE_CREATOR, POSES_ELEMENT, FIGURES_ELEMENT, ORIGIN_ELEMENT = 0x0019, "ULTRAGRAY", 0x01, 0x02, 0x03
MAX_PIXEL_BYTES = 2**32 - 2  # the length of an element (PS3.5 7.1.1)
TISSUE_2D, TISSUE, CENTIMETRES = 1, 1, 3  # C.8.5.5.1.1, .2, .15
MAX_WORDS_BYTES = 64  # of a value of VR LO, with its padding
MAX_COMMENTS = 10_240  # characters of a value of VR LT
_UIDS = uuid.UUID("0f2bb0a1-93a5-5ab2-8a2c-5d1f1e4a7c60")


class DicomExporter(Exporter):
    """A writer of the data set at once, then of the frames into its last element, then of the figures."""

    def _open(self) -> None:
        header = self._header
        self._annotated = AnnotatedPictures(header.settings.picture, header.annotations)
        self._bytes = len(header.poses) * self._annotated.rows * self._annotated.picture.width
        if self._bytes > MAX_PIXEL_BYTES:
            raise InvalidArgument(
                f"format dicom holds at most {MAX_PIXEL_BYTES:,} pixels in a file, {len(header.poses):,} frames of "
                f"{header.settings.picture.height}x{header.settings.picture.width} are {self._bytes:,}",
                field="format",
            )
        self._file = self._stack.enter_context(self._path.open("wb"))
        self._data_set().save_as(self._file, enforce_file_format=True)
        padded = self._bytes + self._bytes % 2
        self._file.write(struct.pack("<HH2sHI", 0x7FE0, 0x0010, b"OB", 0, padded))  # PixelData

    def _write(self, frames: Mapping[str, PixelArray], count: int) -> None:
        for index, pixels in enumerate(frames["bmode"], self._done):
            self._file.write(self._annotated.burnt(pixels, index).data)

    def _finish(self) -> None:
        self._file.write(b"\0" * (self._bytes % 2))
        self._file.seek(0)
        self._data_set().save_as(self._file, enforce_file_format=True)

    def _data_set(self) -> FileDataset:
        header = self._header
        poses = np.ascontiguousarray(header.poses, "<f8")
        made_of = [
            header.origin(),
            header.settings.height,
            header.settings.width,
            hashlib.sha256(poses.tobytes()).hexdigest(),
            [to_dict(one) for one in header.annotations],
        ]
        own, day = f"{json.dumps(made_of, sort_keys=True)} {header.made_at}", f"{header.made_at:%Y%m%d}"
        names = f"image {own}", f"series {own}", f"study {header.scene_sha256} {day}"
        image_uid, series_uid, study_uid = (UID(f"2.25.{uuid.uuid5(_UIDS, name).int}") for name in names)
        storage = UltrasoundImageStorage if len(poses) == 1 else UltrasoundMultiFrameImageStorage
        meta = FileMetaDataset()
        meta.MediaStorageSOPClassUID = storage
        meta.MediaStorageSOPInstanceUID = image_uid
        meta.TransferSyntaxUID = ExplicitVRLittleEndian
        data = FileDataset(self._path, {}, file_meta=meta, preamble=b"\0" * 128)
        data.SpecificCharacterSet = "ISO_IR 192"
        data.SOPClassUID, data.SOPInstanceUID = storage, image_uid
        data.StudyInstanceUID, data.SeriesInstanceUID = study_uid, series_uid
        self._describe(data)
        self._describe_pixels(data)
        if (transducer := self._header.settings.probe.dicom_type) is not None:
            data.TransducerType = transducer
        data.SequenceOfUltrasoundRegions = [self._region()]
        figures = np.stack(list(self._figures().values()), axis=1).astype("<f4")
        block = data.private_block(PRIVATE_GROUP, PRIVATE_CREATOR, create=True)
        block.add_new(POSES_ELEMENT, "OD", poses.tobytes())
        block.add_new(FIGURES_ELEMENT, "OF", figures.tobytes())
        block.add_new(ORIGIN_ELEMENT, "UT", json.dumps(self._header.origin()))
        return data

    def _describe(self, data: Dataset) -> None:
        """The modules Patient, General Study, General Series, General Equipment and General Image."""
        header = self._header
        data.PatientName, data.PatientID = "UltraG-Ray^Simulated", "ULTRAGRAY"
        data.PatientBirthDate = data.PatientSex = ""
        data.PatientIdentityRemoved, data.DeidentificationMethod = "YES", "simulated, of no person"
        data.ReferringPhysicianName = data.AccessionNumber = ""
        data.StudyID = "1"
        day, time = f"{header.made_at:%Y%m%d}", f"{header.made_at:%H%M%S.%f}"
        data.StudyDate = data.SeriesDate = data.AcquisitionDate = data.ContentDate = day
        data.StudyTime, data.SeriesTime, data.AcquisitionTime, data.ContentTime = "", time, time, time
        data.TimezoneOffsetFromUTC = "+0000"
        data.StudyDescription = _words(header.scene)
        data.Modality, data.SeriesNumber, data.Laterality = "US", 1, ""
        data.Manufacturer, data.ManufacturerModelName = "UltraG-Ray", "UltraG-Ray"
        data.SoftwareVersions = _words(header.renderer)
        data.InstanceNumber, data.PatientOrientation = 1, ""
        data.ImageType = ["DERIVED", "PRIMARY"]
        data.DerivationDescription = f"rendered from the scene with SHA-256 {header.scene_sha256}"
        data.BurnedInAnnotation, data.LossyImageCompression = "YES" if header.annotations else "NO", "00"
        comments = "\r\n".join(one.text for one in header.annotations if one.text)
        if comments:
            allowed = "".join(one for one in comments if one.isprintable() or one in "\r\n\t")
            data.ImageComments = allowed[:MAX_COMMENTS]

    def _describe_pixels(self, data: Dataset) -> None:
        """The modules Image Pixel, Cine, Multi-frame and US Image."""
        picture = self._annotated.picture
        data.SamplesPerPixel, data.PhotometricInterpretation, data.PixelRepresentation = 1, "MONOCHROME2", 0
        data.BitsAllocated, data.BitsStored, data.HighBit = 8, 8, 7
        data.Rows, data.Columns = self._annotated.rows, picture.width
        if len(self._header.poses) > 1:
            self._describe_frames(data)
        aspect = Fraction(picture.step[1] / abs(picture.step[0])).limit_denominator(10_000)
        if aspect != 1 and aspect != 0:
            data.PixelAspectRatio = [aspect.numerator, aspect.denominator]

    def _describe_frames(self, data: Dataset) -> None:
        """The modules Cine and Multi-frame: a time for all frames, or the time from each to the one before it."""
        count, times = len(self._header.poses), self._header.frame_times_ms
        data.NumberOfFrames = count
        if times is None:
            data.FrameTime, data.FrameIncrementPointer = f"{FRAME_TIME_MS:g}", 0x00181063
            mean_ms = FRAME_TIME_MS
        else:
            data.FrameTimeVector, data.FrameIncrementPointer = (
                [f"{way:.1f}" for way in np.diff(times, prepend=times[0])],
                0x00181065,
            )
            mean_ms = max(1.0, (times[-1] - times[0]) / (count - 1))
        data.RecommendedDisplayFrameRate = max(1, round(1000.0 / mean_ms))

    def _region(self) -> Dataset:
        picture = self._annotated.picture
        region = Dataset()
        region.RegionSpatialFormat, region.RegionDataType = TISSUE_2D, TISSUE
        region.RegionFlags = 0  # high priority, not protected from scaling
        region.RegionLocationMinX0 = region.RegionLocationMinY0 = 0
        region.RegionLocationMaxX1, region.RegionLocationMaxY1 = picture.width - 1, picture.height - 1
        region.ReferencePixelX0 = region.ReferencePixelY0 = 0
        region.PhysicalUnitsXDirection = region.PhysicalUnitsYDirection = CENTIMETRES
        region.ReferencePixelPhysicalValueX = picture.first[0] / 10.0
        region.ReferencePixelPhysicalValueY = picture.first[1] / 10.0
        region.PhysicalDeltaX, region.PhysicalDeltaY = picture.step[0] / 10.0, picture.step[1] / 10.0
        return region


def _words(text: str) -> str:
    """A value of VR LO: one line without backslashes, cut to its greatest length."""
    line = " ".join(text.replace("\\", "/").split())
    return line.encode()[:MAX_WORDS_BYTES].decode(errors="ignore")

"""DICOM cine loops with their poses, as pydicom and numpy write them."""

import numpy as np
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, UltrasoundMultiFrameImageStorage

FRAMES = np.random.default_rng(3).integers(5, 250, (10, 24, 32), dtype=np.uint8)
POSES = np.tile(np.eye(4), (10, 1, 1))
POSES[:, :3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
POSES[:, 1, 3] = np.arange(10)

REGION = {
    "RegionSpatialFormat": 1,
    "RegionDataType": 1,
    "RegionLocationMinX0": 4,
    "RegionLocationMinY0": 2,
    "RegionLocationMaxX1": 23,
    "RegionLocationMaxY1": 21,
    "PhysicalUnitsXDirection": 3,
    "PhysicalUnitsYDirection": 3,
    "PhysicalDeltaX": 0.05,
    "PhysicalDeltaY": 0.025,
}


def region(**values):
    """Columns 4 to 23 and rows 2 to 21, 0.5 x 0.25 mm each; None leaves an attribute out."""
    made = Dataset()
    for name, value in {**REGION, **values}.items():
        if value is not None:
            setattr(made, name, value)
    return made


def write_cine(folder, *, syntax=ExplicitVRLittleEndian, poses=POSES, data=None, **values):
    """Writes sweep.dcm and, unless they are None, sweep.poses.npy; None leaves an attribute out."""
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = UltrasoundMultiFrameImageStorage, "1.2.3"
    meta.TransferSyntaxUID = syntax
    made = FileDataset("sweep.dcm", {}, file_meta=meta, preamble=b"\0" * 128)
    described = {
        "SOPClassUID": UltrasoundMultiFrameImageStorage,
        "SOPInstanceUID": "1.2.3",
        "SamplesPerPixel": 1,
        "PhotometricInterpretation": "MONOCHROME2",
        "NumberOfFrames": len(FRAMES),
        "Rows": FRAMES.shape[1],
        "Columns": FRAMES.shape[2],
        "BitsAllocated": 8,
        "BitsStored": 8,
        "HighBit": 7,
        "PixelRepresentation": 0,
        "TransducerType": "LINEAR",
        "SequenceOfUltrasoundRegions": [region()],
        "PixelData": FRAMES.tobytes() if data is None else data,
        **values,
    }
    for name, value in described.items():
        if value is not None:
            setattr(made, name, value)
    made["PixelData"].VR = "OB"
    path = folder / "sweep.dcm"
    made.save_as(path, enforce_file_format=True)
    if poses is not None:
        np.save(folder / "sweep.poses.npy", poses)
    return path

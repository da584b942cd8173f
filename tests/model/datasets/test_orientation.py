"""Stored orientations brought to x lateral, y depth."""

from pathlib import Path

import numpy as np
import pytest

from ultragray.datasets.plus_files import orient_frames
from ultragray.errors import DatasetInvalid

MF = np.arange(12, dtype=np.uint8).reshape(1, 3, 4)  # rows: depth, columns: towards the marked side


@pytest.mark.parametrize(
    ("orientation", "stored"),
    [
        ("MF", MF),
        ("MFA", MF),
        ("MFD", MF),
        ("XX", MF),
        ("", MF),
        ("UF", MF[:, :, ::-1]),
        ("MN", MF[:, ::-1]),
        ("MNA", MF[:, ::-1]),
        ("UN", MF[:, ::-1, ::-1]),
        ("FM", MF.transpose(0, 2, 1)),
        ("FMA", MF.transpose(0, 2, 1)),
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

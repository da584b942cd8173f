"""Sequences that SimpleITK wrote: colour, both formats, compressed or not, and fans with their geometry."""

import numpy as np
import pytest
import SimpleITK

from ultragray import ConvexProbe
from ultragray.datasets.plus import read_plus_sweep

from .test_fan import FAN, of_both, screen


def write(path, frames, fields, *, compressed=False):
    """Frames [F, rows, columns] or [F, rows, columns, 3] with the fields of a sequence."""
    image = SimpleITK.GetImageFromArray(frames, isVector=frames.ndim == 4)
    for key, value in fields.items():
        image.SetMetaData(key, value)
    SimpleITK.WriteImage(image, str(path), compressed)
    return path


def fields_of(plus_files, frames):
    own = plus_files.tracked_fields(frames)
    return {key: value for key, value in own.items() if key.startswith(("Seq_Frame", "Ultrasound"))}


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("name", ["s.mha", "s.mhd", "s.nrrd", "s.nhdr"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_colour_becomes_luma(tmp_path, plus_files, device_set, name, compressed, dtype):
    colours = np.random.default_rng(2).integers(0, 256, (3, 24, 32, 3)).astype(dtype)
    colours[0, 0, 0] = 255
    fields = {**fields_of(plus_files, 3), "UltrasoundImageType": "RGB_COLOR"}
    stored = colours if dtype == np.uint8 else 256 * colours.astype(np.uint16)
    sweep, count = read_plus_sweep(write(tmp_path / name, stored, fields, compressed=compressed), device_set=device_set)
    assert (count, sweep.images.shape) == (3, (3, 24, 32))
    assert np.abs(sweep.images - colours @ [0.299, 0.587, 0.114]).max() <= 1


@pytest.mark.parametrize("name", ["s.mha", "s.nrrd"])
def test_a_fan_has_the_geometry_that_it_was_written_with(tmp_path, plus_files, device_set, name):
    frames = np.stack([screen(of_both)] * 2)
    written = write(tmp_path / name, frames, fields_of(plus_files, 2))
    ours = plus_files.write_mha(tmp_path / "ours.mha", frames, plus_files.tracked_fields(2))
    sweep, _ = read_plus_sweep(written, device_set=device_set, fan=FAN)
    expected, _ = read_plus_sweep(ours, device_set=device_set, fan=FAN)
    assert sweep.probe == expected.probe == ConvexProbe(60.0, 10.0, 26.0)
    np.testing.assert_array_equal(sweep.images, expected.images)
    np.testing.assert_array_equal(sweep.poses, expected.poses)

"""PLUS sequences: poses as the toolkit defines them, everything a recording may hold, files that SimpleITK wrote."""

import gzip

import numpy as np
import pytest
import SimpleITK

from ultragray import ConvexProbe, LinearProbe
from ultragray.datasets.plus import read_plus_sweep
from ultragray.datasets.source import SourceOptions, load_dataset
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.geometry.rotations import rotation_angles_deg

from .conftest import DEVICE_SET
from .test_fan import FAN, of_both, screen

ROWS, COLUMNS = 30, 20
TURN = np.array([[0.0, -1, 0, 3], [1, 0, 0, 4], [0, 0, 1, 5], [0, 0, 0, 1]])


@pytest.mark.parametrize(
    ("sequence", "xml", "name", "crop", "size", "train_frames", "pixels"),
    [
        (
            *("SpinePhantomFreehand", "SpinePhantomFreehandReconstructionOnly", "spine_phantom"),
            *("188:632,12:600", "192x256", None, 1.5),
        ),
        (
            *("fCal_Test_Calibration_3NWires_fCal2.0", "fCal_Sim_VolumeReconstruction", "nwire_phantom"),
            *("164:654,0:616", "176x216", ":189", 0.1),
        ),
    ],
)
def test_real_sequences_agree_with_the_sets_made_from_them(
    data_folder, sequence, xml, name, crop, size, train_frames, pixels
):
    folder = data_folder / "plus_original"
    options = SourceOptions(
        device_set=folder / f"PlusDeviceSet_{xml}.xml", crop=crop, image_size=size, train_frames=train_frames
    )
    ours, theirs = load_dataset(folder / f"{sequence}.igs.mha", options), load_dataset(data_folder / name)
    pairs = [(ours.train, theirs.train)] if train_frames else [(ours.train, theirs.train), (ours.val, theirs.val)]
    for got, expected in pairs:
        expected = expected.select(range(len(got)))
        assert len(got) == len(expected)
        assert np.linalg.norm(got.poses[:, :3, 3] - expected.poses[:, :3, 3], axis=1).max() < 1e-3
        assert np.diag(rotation_angles_deg(got.poses, expected.poses)).max() < 1e-3
        assert got.probe.far_mm == pytest.approx(expected.probe.far_mm, abs=1e-3)
        assert np.abs(got.images.astype(float) - expected.images).mean() < pixels
    if not train_frames:
        assert len(ours.train) + len(ours.val) == 21
        assert ours.val.frame_numbers.tolist() == [2, 7, 12, 17]


def test_a_sequence_with_its_device_set(tmp_path, plus_files, device_set):
    stored = plus_files.speckle(4, ROWS, COLUMNS)
    path = plus_files.write_mha(tmp_path / "s.igs.mha", stored, plus_files.tracked_fields(4))
    sweep, frame_count = read_plus_sweep(path, device_set=device_set, crop="2:12,3:23", frames="1:")
    assert frame_count == 4
    assert sweep.frame_numbers.tolist() == [1, 2, 3]
    np.testing.assert_array_equal(sweep.images, stored[1:, 3:23, 2:12])
    assert sweep.probe == LinearProbe(width_mm=2.0, near_mm=0.0, far_mm=2.0)
    np.testing.assert_allclose(sweep.poses[:, :3, :3], np.tile(np.eye(3), (3, 1, 1)), atol=1e-12)
    # the middle of columns 2 … 11 is 6.5, the upper edge of row 3 is 2.5
    np.testing.assert_allclose(sweep.poses[0, :3, 3], (10 - 3 + 0.2 * 6.5, 1 + 1, 2 + 0.1 * 2.5))


def test_the_reference_is_the_frame_of_the_poses_where_it_is_tracked(tmp_path, plus_files, device_set):
    stored, fields = plus_files.speckle(3, ROWS, COLUMNS), plus_files.tracked_fields(3)
    plain, _ = read_plus_sweep(plus_files.write_mha(tmp_path / "t.mha", stored, fields), device_set=device_set)
    fields |= {f"Seq_Frame{f:04d}_ReferenceToTrackerTransform": plus_files.numbers(TURN) for f in range(3)}
    turned, _ = read_plus_sweep(plus_files.write_mha(tmp_path / "r.mha", stored, fields), device_set=device_set)
    np.testing.assert_allclose(turned.poses, np.linalg.inv(TURN) @ plain.poses, atol=1e-12)


def test_the_calibration_may_be_in_the_sequence(tmp_path, plus_files, device_set):
    stored, fields = plus_files.speckle(2, ROWS, COLUMNS), plus_files.tracked_fields(2)
    expected, _ = read_plus_sweep(plus_files.write_mha(tmp_path / "a.mha", stored, fields), device_set=device_set)
    own = fields | {
        f"Seq_Frame{f:04d}_ImageToProbeTransform": plus_files.numbers(plus_files.image_to_probe) for f in range(2)
    }
    sweep, _ = read_plus_sweep(plus_files.write_mha(tmp_path / "b.mha", stored, own))
    np.testing.assert_allclose(sweep.poses, expected.poses)
    direct = {
        f"Seq_Frame{f:04d}_ImageToReferenceTransform": plus_files.numbers(
            plus_files.translation(10, f, 0) @ plus_files.image_to_probe
        )
        for f in range(2)
    }
    sweep, _ = read_plus_sweep(plus_files.write_mha(tmp_path / "c.mha", stored, direct))
    np.testing.assert_allclose(sweep.poses, expected.poses)


@pytest.mark.parametrize("suffix", ["igs.mha", "seq.nrrd"])
def test_a_stored_orientation_gives_the_same_sweep(tmp_path, plus_files, device_set, suffix):
    frames, fields = plus_files.speckle(3, ROWS, COLUMNS), plus_files.tracked_fields(3)
    expected, _ = read_plus_sweep(
        plus_files.write_mha(tmp_path / "mf.mha", frames, fields), device_set=device_set, crop="2:12,3:23"
    )
    stored = np.ascontiguousarray(frames.swapaxes(1, 2)[:, :, ::-1])
    write, key = (
        (plus_files.write_mha, "UltrasoundImageOrientation")
        if suffix == "igs.mha"
        else (plus_files.write_nrrd, "ultrasound image orientation")
    )
    path = write(tmp_path / f"s.{suffix}", stored, {key: "NMA", **fields})
    sweep, _ = read_plus_sweep(path, device_set=device_set, crop="2:12,3:23")
    np.testing.assert_array_equal(sweep.images, expected.images)
    np.testing.assert_array_equal(sweep.poses, expected.poses)


def test_invalid_frames_are_left_out_and_told(tmp_path, plus_files, device_set):
    fields = plus_files.tracked_fields(6)
    fields["Seq_Frame0001_ProbeToTrackerTransform"] = plus_files.numbers(np.eye(4))
    fields["Seq_Frame0001_ProbeToTrackerTransformStatus"] = "INVALID"
    fields["Seq_Frame0003_ImageStatus"] = "INVALID"
    del fields["Seq_Frame0005_ProbeToTrackerTransform"]
    del fields["Seq_Frame0004_ProbeToTrackerTransformStatus"]  # none: taken to be valid
    path = plus_files.write_mha(tmp_path / "s.mha", plus_files.speckle(6, ROWS, COLUMNS), fields)
    sweep, frame_count = read_plus_sweep(path, device_set=device_set)
    assert (sweep.frame_numbers.tolist(), frame_count) == ([0, 2, 4], 6)
    assert sweep.notes[0] == (
        "frames without a valid pose or image were left out: 1, 3, 5 (3 in all: ProbeToTracker INVALID in 1; "
        "ImageStatus INVALID in 1; ProbeToTracker missing in 1)"
    )
    fields["Seq_Frame0000_ProbeToTrackerTransform"] = "nan " * 16
    path = plus_files.write_mha(tmp_path / "s.mha", plus_files.speckle(6, ROWS, COLUMNS), fields)
    lost, _ = read_plus_sweep(path, device_set=device_set)
    assert lost.frame_numbers.tolist() == [2, 4]
    assert "ProbeToTracker NaN in 1" in lost.notes[0]
    assert "oriented" in sweep.notes[1]
    assert "the whole image of 20 x 30 pixels" in sweep.notes[2]


def test_frames_of_a_lifted_probe_are_left_out_and_told(tmp_path, plus_files, device_set):
    stored = plus_files.speckle(6, ROWS, COLUMNS)
    stored[[1, 4]] = 0
    path = plus_files.write_mha(tmp_path / "s.mha", stored, plus_files.tracked_fields(6))
    sweep, _ = read_plus_sweep(path, device_set=device_set)
    assert sweep.frame_numbers.tolist() == [0, 2, 3, 5]
    assert sweep.notes[-1] == "frames in which every pixel is the same were left out: 1, 4 (2 in all)"


@pytest.mark.parametrize("suffix", ["mha", "nrrd"])
def test_fields_that_do_not_go_with_the_images_are_told_or_refused(tmp_path, plus_files, device_set, suffix):
    stored, fields = plus_files.speckle(4, ROWS, COLUMNS), plus_files.tracked_fields(7)
    write = getattr(plus_files, f"write_{suffix}")
    sweep, count = read_plus_sweep(write(tmp_path / f"more.{suffix}", stored, fields), device_set=device_set)
    assert (count, len(sweep)) == (4, 4)
    assert sweep.notes[0] == "it has 4 images, but fields of frames beyond them, which are left out: 4, 5, 6 (3 in all)"
    from_one = {key: value for key, value in plus_files.tracked_fields(5).items() if "Frame0000" not in key}
    message = (
        r"4 images must be counted from Seq_Frame0000, they go from Seq_Frame0001 to Seq_Frame0004: counted from 1"
    )
    with pytest.raises(DatasetInvalid, match=message):
        read_plus_sweep(write(tmp_path / f"one.{suffix}", stored, from_one), device_set=device_set)


def test_an_invalid_reference_does_not_change_the_frame_of_the_poses(tmp_path, plus_files, device_set):
    fields = plus_files.tracked_fields(3)
    for frame, status in enumerate(("OK", "INVALID", "OK")):
        fields[f"Seq_Frame{frame:04d}_ReferenceToTrackerTransform"] = plus_files.numbers(TURN)
        fields[f"Seq_Frame{frame:04d}_ReferenceToTrackerTransformStatus"] = status
    path = plus_files.write_mha(tmp_path / "s.mha", plus_files.speckle(3, ROWS, COLUMNS), fields)
    assert read_plus_sweep(path, device_set=device_set)[0].frame_numbers.tolist() == [0, 2]


def test_bad_recordings_are_one_clear_error(tmp_path, plus_files, device_set):
    stored, good = plus_files.speckle(3, ROWS, COLUMNS), plus_files.tracked_fields(3)
    key = "Seq_Frame0002_ProbeToTrackerTransform"

    def refused(message, changes, frames=stored):
        path = plus_files.write_mha(tmp_path / "s.mha", frames, good | changes)
        with pytest.raises(DatasetInvalid, match=rf"s\.mha: {message}"):
            read_plus_sweep(path, device_set=device_set)

    refused("frame 2: ProbeToTracker must .*mirrored", {key: plus_files.numbers(np.diag([1.0, 1, -1, 1]))})
    refused("frame 2: ProbeToTracker must .*rotation", {key: plus_files.numbers(np.diag([2.0, 2, 2, 1]))})
    refused("frame 2: ProbeToTracker must be sixteen finite", {key: "inf " * 16})
    refused("frame 2: ProbeToTracker must be sixteen finite", {key: "1 0 0"})
    refused("images must be B-mode .* RF_REAL", {"UltrasoundImageType": "RF_REAL"})
    refused("UltrasoundImageOrientation must be", {"UltrasoundImageOrientation": "AMF"})
    refused("in each frame every pixel is the same: 0, 1, 2", {}, np.full_like(stored, 3))
    refused(
        "none of its 3 frames has a valid ProbeToTracker",
        {f"Seq_Frame{frame:04d}_ProbeToTrackerTransformStatus": "INVALID" for frame in range(3)},
    )


def test_what_is_missing_is_told(tmp_path, plus_files, device_set):
    stored = plus_files.speckle(3, ROWS, COLUMNS)
    path = plus_files.write_mha(tmp_path / "s.mha", stored, plus_files.tracked_fields(3))
    with pytest.raises(DatasetInvalid, match=r"no transforms lead .*there are ProbeToTracker .*give the device set"):
        read_plus_sweep(path)
    other = {f"Seq_Frame{frame:04d}_needleToTrackerTransform": plus_files.numbers(np.eye(4)) for frame in range(3)}
    path = plus_files.write_mha(tmp_path / "s.mha", stored, other)
    with pytest.raises(DatasetInvalid, match=r"there are ImageToProbe \(Image leads to Probe alone: has the"):
        read_plus_sweep(path, device_set=device_set)
    path = plus_files.write_mha(tmp_path / "s.mha", stored, {})
    for known in (None, device_set):
        with pytest.raises(DatasetInvalid, match=r"s\.mha: its frames have no transforms: 3D Slicer saves images and"):
            read_plus_sweep(path, device_set=known)
    path = plus_files.write_mha(tmp_path / "s.mha", stored, plus_files.tracked_fields(3))
    with pytest.raises(InvalidArgument, match=r"crop must lie within columns 0:20 and rows 0:30"):
        read_plus_sweep(path, device_set=device_set, crop="0:21,0:30")
    with pytest.raises(InvalidArgument, match=r"^frames.*only 3"):
        read_plus_sweep(path, device_set=device_set, frames="0:9")


def written(path, frames, fields, *, compressed=False):
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
    sweep, count = read_plus_sweep(
        written(tmp_path / name, stored, fields, compressed=compressed), device_set=device_set
    )
    assert (count, sweep.images.shape) == (3, (3, 24, 32))
    assert np.abs(sweep.images - colours @ [0.299, 0.587, 0.114]).max() <= 1


@pytest.mark.parametrize("name", ["s.mha", "s.nrrd"])
def test_a_fan_has_the_geometry_that_it_was_written_with(tmp_path, plus_files, device_set, name):
    frames = np.stack([screen(of_both)] * 2)
    path = written(tmp_path / name, frames, fields_of(plus_files, 2))
    ours = plus_files.write_mha(tmp_path / "ours.mha", frames, plus_files.tracked_fields(2))
    sweep, _ = read_plus_sweep(path, device_set=device_set, fan=FAN)
    expected, _ = read_plus_sweep(ours, device_set=device_set, fan=FAN)
    assert not any("the whole image" in note for note in sweep.notes)
    assert sweep.probe == expected.probe == ConvexProbe(60.0, 10.0, 26.0)
    np.testing.assert_array_equal(sweep.images, expected.images)
    np.testing.assert_array_equal(sweep.poses, expected.poses)


def as_crlf(data):
    head, mark, pixels = data.partition(b"ElementDataFile = LOCAL\n")
    return (head + mark).replace(b"\n", b"\r\n") + pixels


def test_one_recording_as_other_writers_have_it(tmp_path, plus_files, device_set):
    """MetaIO's and PLUS's own spellings, sizes, statuses and directions give the same poses and pixels."""
    stored, tracked = plus_files.speckle(4, ROWS, COLUMNS), plus_files.tracked_fields(4)
    tracked["UltrasoundImageOrientation"] = "MF"
    expected = read_plus_sweep(plus_files.write_mha(tmp_path / "s.mha", stored, tracked), device_set=device_set)[0]
    inverse = {"UltrasoundImageOrientation": "MF"}
    for frame in range(4):
        matrix = plus_files.numbers(plus_files.translation(-10, -frame, 0))
        inverse[f"Seq_Frame{frame:04d}_TrackerToProbeTransform"] = matrix
    whole = stored.tobytes()
    others = {
        "lower case": {key: value.lower() for key, value in tracked.items()},
        "no statuses": {key: value for key, value in tracked.items() if not key.endswith("Status")},
        "from the tracker": inverse,
        "to a reference": {key.replace("Tracker", "Reference"): value for key, value in tracked.items()},
        "volumes of a slice": {**tracked, "NDims": "4", "DimSize": f"{COLUMNS} {ROWS} 1 4"},
        "lines end as in Windows": tracked,
        "two members of gzip": {**tracked, "CompressedData": "True", "CompressedDataSize": "0"},
        "another tracked thing": {
            **tracked,
            **{f"Seq_Frame000{frame}_StylusToTrackerTransform": plus_files.numbers(np.eye(4)) for frame in range(4)},
        },
    }
    for name, fields in others.items():
        path = plus_files.write_mha(tmp_path / "other.igs.mha", stored, fields, deflate=False)
        data = path.read_bytes()
        if name.startswith("lines"):
            path.write_bytes(as_crlf(data))
        if name.startswith("two members"):
            path.write_bytes(data.removesuffix(whole) + gzip.compress(whole[:100]) + gzip.compress(whole[100:]))
        found, _ = read_plus_sweep(path, device_set=device_set)
        assert np.abs(found.poses - expected.poses).max() < 1e-9, name
        np.testing.assert_array_equal(found.images, expected.images)


def test_lengths_that_contradict_each_other_are_told(tmp_path, plus_files, device_set):
    def notes(fields, calibration=plus_files.image_to_probe):
        device_set.write_text(DEVICE_SET.format(matrix=plus_files.numbers(calibration)))
        path = plus_files.write_mha(tmp_path / "s.mha", plus_files.speckle(3, ROWS, COLUMNS), fields)
        return "; ".join(read_plus_sweep(path, device_set=device_set)[0].notes)

    tracked = plus_files.tracked_fields(3)
    told = r"ElementSpacing says pixels of 0.5 x 0.5 mm, the calibration 0.2 x 0.1: this one is taken"
    assert told in notes({**tracked, "ElementSpacing": "0.5 0.5 1"})
    assert "ElementSpacing" not in notes({**tracked, "ElementSpacing": "0.2 0.1 1"}) + notes(tracked)
    metres, halves = plus_files.image_to_probe.copy(), plus_files.image_to_probe.copy()
    metres[:3, 3] /= 1000
    halves[:3, 3] = halves[:3, :2] @ (0.5, 0.5)
    assert "the calibration puts the first pixel 0.00374 mm from the sensor: is its translation in metres" in notes(
        tracked, metres
    )
    assert "from the sensor" not in notes(tracked, halves) + notes(tracked)
    halves[:3, 3] = 0
    assert "from the sensor" not in notes(tracked, halves)

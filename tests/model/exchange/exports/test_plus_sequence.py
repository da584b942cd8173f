import dataclasses
import re

import cv2
import numpy as np
import pytest

from ultragray import ConvexProbe, LinearProbe, PhasedProbe
from ultragray.datasets.fan import parse_matrix
from ultragray.datasets.plus import read_plus_sweep
from ultragray.datasets.plus_files import read_meta_image
from ultragray.errors import DatasetInvalid
from ultragray.exchange.exports import export_to
from ultragray.geometry.pose import pose_from_position_quaternion
from ultragray.geometry.scan_conversion import scan_convert
from ultragray.rendering.display import Display
from ultragray.rendering.settings import Resolved
from ultragray.scene.confidence import Extrapolation

from .conftest import exported, header_of

FRAMES = np.random.default_rng(0).random((12, 20, 16), np.float32)
TOLD = [Extrapolation(number / 3.0, 1234.5, None, 1e-4 * number) for number in range(12)]


def poses(count):
    random = np.random.default_rng(1)
    made = []
    for _ in range(count):
        w, x, y, z = random.normal(size=4)
        norm = np.sqrt(w * w + x * x + y * y + z * z)
        place = random.normal(0, 100, 3)
        made.append(pose_from_position_quaternion((*place,), (w / norm, x / norm, y / norm, z / norm)))
    return np.stack(made)


def export(path, probe):
    header = header_of("plus", Resolved(probe, 20, 16), poses=poses(12))
    exported(path, "plus", header, {"bmode": FRAMES}, TOLD)
    return header


def test_our_reader_gives_back_the_same_frames_and_poses(tmp_path):
    probe = LinearProbe(width_mm=38.1, near_mm=0.0, far_mm=51.7)
    header = export(tmp_path / "sweep.igs.mha", probe)
    sweep, count = read_plus_sweep(tmp_path / "sweep.igs.mha")
    assert count == 12
    np.testing.assert_array_equal(sweep.images, np.rint(FRAMES * 255))
    np.testing.assert_allclose(sweep.poses, header.poses, rtol=1e-9, atol=1e-10)
    assert sweep.probe == probe
    assert [note for note in sweep.notes if "no crop" not in note] == []


def test_a_near_plane_moves_the_poses_to_the_top_of_the_image(tmp_path):
    header = export(tmp_path / "sweep.igs.mha", LinearProbe(width_mm=40.0, near_mm=5.0, far_mm=50.0))
    sweep, _ = read_plus_sweep(tmp_path / "sweep.igs.mha")
    np.testing.assert_allclose(sweep.poses @ [0, 0, -5.0, 1], header.poses[:, :, 3], atol=1e-9)
    assert sweep.probe == LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=45.0)


def test_every_frame_has_its_fields(tmp_path):
    header = export(tmp_path / "sweep.igs.mha", LinearProbe(40.0, 0.0, 50.0))
    stored = read_meta_image(tmp_path / "sweep.igs.mha")
    assert stored.fields["UltrasoundImageOrientation"] == "MF"
    assert stored.fields["UltrasoundImageType"] == "BRIGHTNESS"
    assert stored.fields["DimSize"] == "16 20 12"
    for number, fields in enumerate(stored.frame_fields):
        assert set(fields) == {
            "ProbeToTrackerTransform",
            "ProbeToTrackerTransformStatus",
            "ImageToProbeTransform",
            "ImageToProbeTransformStatus",
            "FrameNumber",
            "Timestamp",
            "ImageStatus",
            "UltraGRayDistanceMm",
            "UltraGRayAngleDeg",
            "UltraGRayConfidence",
            "UltraGRaySupportedShare",
        }
        assert float(fields["UltraGRayDistanceMm"]) == pytest.approx(number / 3.0)
        assert (float(fields["UltraGRayAngleDeg"]), fields["UltraGRayConfidence"]) == (1234.5, "nan")
        assert float(fields["UltraGRaySupportedShare"]) == pytest.approx(1e-4 * number)
        assert {value for key, value in fields.items() if key.endswith("Status")} == {"OK"}
        assert float(fields["Timestamp"]) == number * 0.04
        np.testing.assert_array_equal(parse_matrix(fields["ProbeToTrackerTransform"], "it"), header.poses[number])
        image = parse_matrix(fields["ImageToProbeTransform"], "it")
        assert np.linalg.det(image[:3, :3]) > 0
        np.testing.assert_allclose(image @ [0, 0, 0, 1], [-18.75, 0, 1.25, 1])
        np.testing.assert_allclose(image @ [15, 19, 0, 1], [18.75, 0, 48.75, 1])


def test_a_fan_is_scan_converted(tmp_path):
    probe = ConvexProbe(opening_angle_deg=60.0, near_mm=20.0, far_mm=60.0)
    export(tmp_path / "sweep.igs.mha", probe)
    stored = read_meta_image(tmp_path / "sweep.igs.mha")
    fan = np.rint(255 * scan_convert(FRAMES[3], probe, 2.0))
    np.testing.assert_allclose(stored.pixels[3], fan, atol=1)
    assert (stored.pixels[3] == fan).mean() > 0.99
    image = parse_matrix(stored.frame_fields[3]["ImageToProbeTransform"], "it")
    columns = stored.pixels.shape[2]
    top = image @ [(columns - 1) / 2, -0.5, 0, 1]
    np.testing.assert_allclose(top, [0, 0, 20 * np.cos(np.pi / 6), 1], atol=1e-12)
    np.testing.assert_allclose(image[:3, 0] + image[:3, 1], [2, 0, 2])


@pytest.mark.parametrize(
    ("probe", "display"),
    [
        (ConvexProbe(opening_angle_deg=60.0, near_mm=20.0, far_mm=60.0), Display()),
        (PhasedProbe(opening_angle_deg=80.0, far_mm=45.0), Display()),
        (ConvexProbe(opening_angle_deg=60.0, near_mm=20.0, far_mm=60.0), Display(depth_mm=30.0, flip=True)),
    ],
)
def test_our_reader_brings_a_fan_back_to_scan_lines(tmp_path, probe, display):
    """Probe and poses are those of the export; the frames are the same but for two resamplings of a smooth image."""
    height, width = 200, 160
    rows, lines = np.meshgrid(np.linspace(0.2, 0.9, height), np.linspace(0.3, 1.0, width), indexing="ij")
    smooth = np.broadcast_to((rows * lines).astype(np.float32), (12, height, width))
    header = header_of("plus", Resolved(probe, height, width, display=display), poses=poses(12))
    exported(tmp_path / "sweep.igs.mha", "plus", header, {"bmode": smooth}, TOLD)
    sweep, _ = read_plus_sweep(tmp_path / "sweep.igs.mha")
    depth = display.depth_mm
    assert sweep.probe == (probe if depth is None else probe.ending_at(probe.face_depth_mm + depth))
    expected_poses = header.poses @ np.diag([-1.0, -1.0, 1.0, 1.0]) if display.flip else header.poses
    np.testing.assert_allclose(sweep.poses, expected_poses, rtol=1e-9, atol=1e-9)
    truth = smooth[0][: display.rows_shown(probe, height), :: -1 if display.flip else 1]
    found = sweep.images[3] / 255.0
    expected = cv2.resize(truth, found.shape[::-1], interpolation=cv2.INTER_LINEAR)
    near = len(found) // 4 if probe.near_mm == 0.0 else 3  # scan lines meet in the apex of a phased array
    assert np.abs(found - expected)[near:-3, 3:-3].max() < 0.02
    assert any("fan of the file was taken" in note for note in sweep.notes)
    cropped, _ = read_plus_sweep(tmp_path / "sweep.igs.mha", crop="100:150,80:130")  # who crops wants no fan
    assert cropped.images.shape == (12, 50, 50)


def test_a_calibration_that_does_not_go_with_the_probe_is_refused(tmp_path):
    path = tmp_path / "sweep.igs.mha"
    export(path, ConvexProbe(opening_angle_deg=60.0, near_mm=20.0, far_mm=60.0))
    turned = b"ImageToProbeTransform = 0 2 0 0 0 0 1 0 2 0 0 0 0 0 0 1"
    path.write_bytes(re.sub(rb"ImageToProbeTransform = .*", turned, path.read_bytes()))
    with pytest.raises(DatasetInvalid, match="must take columns to x and rows to z"):
        read_plus_sweep(path)


@pytest.mark.long
def test_ten_thousand_frames_keep_their_order(tmp_path):
    many = np.tile(np.eye(4), (10_050, 1, 1))
    many[:, 1, 3] = np.arange(10_050)
    header = export(tmp_path / "few.igs.mha", LinearProbe(40.0, 0.0, 50.0))
    header = dataclasses.replace(header, poses=many, settings=Resolved(header.settings.probe, 1, 2))
    with export_to(tmp_path / "many.igs.mha", "plus", header) as add:
        add({"bmode": np.tile(np.array([[[0.0, 1.0]]], np.float32), (10_050, 1, 1))}, TOLD[:1] * 10_050)
    sweep, count = read_plus_sweep(tmp_path / "many.igs.mha", frames="10000:10050")
    assert count == 10_050
    np.testing.assert_allclose(sweep.poses[:, 1, 3], many[10_000:, 1, 3], rtol=1e-9)

"""What a scene tells of a frame: with a model, without one, without views, and without torch."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from ultragray import LinearProbe, SceneInfo, read_header
from ultragray.errors import InvalidArgument, InvalidPose, SceneFileInvalid
from ultragray.scene.confidence import SUPPORT_COVERAGE, Assessor, ConfidenceModel, Extrapolation, supported

PROBE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)
MODEL = ConfidenceModel((3.5, 1.2, 0.8, 0.1, 0.6), 0.06, (0.0, 0.5, 1.0), 20, 0.04)


def moved(*elevations_mm):
    poses = np.tile(np.eye(4), (len(elevations_mm), 1, 1))
    poses[:, 1, 3] = elevations_mm
    return poses


VIEWS = moved(0.0, 1.0, 2.0)
INFO = SceneInfo(probe=PROBE, confidence=MODEL.to_dict())


def test_a_frame_tells_how_far_it_extrapolates():
    on_a_view, beyond = Assessor(INFO, VIEWS).assess(moved(1.0, 6.0))
    assert (on_a_view.distance_mm, on_a_view.angle_deg) == pytest.approx((0.0, 0.0), abs=1e-5)
    assert beyond.distance_mm == pytest.approx(4.0)
    assert on_a_view.confidence is not None
    assert beyond.confidence is not None
    assert on_a_view.confidence > 0.9 > 0.4 > beyond.confidence
    assert beyond.supported_share is None


def test_the_share_of_pixels_with_support():
    coverage = np.array([[[0.0, SUPPORT_COVERAGE - 0.01], [SUPPORT_COVERAGE, 1.0]]], np.float32)
    (told,) = Assessor(INFO, VIEWS).assess(moved(1.0), coverage=coverage)
    assert told.supported_share == 0.5
    assert supported(coverage).tolist() == [[[False, False], [True, True]]]
    with pytest.raises(InvalidArgument, match="one image for each of 2 poses, got 1"):
        Assessor(INFO, VIEWS).assess(moved(0.0, 1.0), coverage=coverage)


def test_another_probe_is_measured_where_it_looks():
    wide = LinearProbe(width_mm=80.0, near_mm=0.0, far_mm=50.0)
    (own,), (other,) = (Assessor(INFO, VIEWS).assess(moved(1.0), probe) for probe in (None, wide))
    assert own.distance_mm == pytest.approx(0.0, abs=1e-9)
    assert other.distance_mm is not None
    assert other.distance_mm > 3.0


def test_a_scene_tells_no_more_than_it_knows():
    coverage = np.ones((1, 4, 4))
    assert Assessor(SceneInfo(probe=PROBE), np.zeros((0, 4, 4))).assess(np.eye(4), coverage=coverage) == [
        Extrapolation(None, None, None, 1.0)
    ]
    assert Assessor(SceneInfo(), VIEWS).assess(np.eye(4), PROBE) == [Extrapolation(None, None, None, None)]
    (told,) = Assessor(SceneInfo(probe=PROBE), VIEWS).assess(moved(4.0))
    assert told.distance_mm == pytest.approx(2.0)
    assert told.confidence is None


def test_what_does_not_fit_is_refused():
    with pytest.raises(InvalidPose):
        Assessor(INFO, VIEWS).assess(3.0 * np.eye(4))
    with pytest.raises(InvalidArgument, match="each of 2 training poses, got 3"):
        Assessor(INFO, VIEWS[:2])


def test_it_is_kept_in_the_scene_file(random_scene, tmp_path):
    scene = random_scene(info={"probe": PROBE, "confidence": MODEL.to_dict()})
    replace(scene, training_poses=VIEWS).save(tmp_path / "scene.ugr")
    header = read_header(tmp_path / "scene.ugr")
    assert ConfidenceModel.from_dict(header.info.confidence) == MODEL
    assert Assessor(header.info, header.training_poses).assess(moved(1.5)) == Assessor(INFO, VIEWS).assess(moved(1.5))


@pytest.mark.parametrize("change", [{"weights": [1.0]}, {"hardness": [0.0]}, {"version": 9}])
def test_a_scene_file_with_a_damaged_model_is_refused(random_scene, tmp_path, change):
    scene = random_scene(info={"probe": PROBE, "confidence": {**MODEL.to_dict(), **change}})
    replace(scene, training_poses=VIEWS).save(tmp_path / "scene.ugr")
    with pytest.raises(SceneFileInvalid, match=r"scene\.ugr.*confidence|weights|hardness"):
        read_header(tmp_path / "scene.ugr")


def test_no_torch_is_needed():
    program = (
        "import sys, numpy as np; from ultragray import SceneInfo; from ultragray.scene.confidence import Assessor; "
        "Assessor(SceneInfo(), np.zeros((0, 4, 4))).assess(np.eye(4)); assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)

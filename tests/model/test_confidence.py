"""What a scene tells of a frame: distances to training views by hand or brute force, the model, limits."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ultragray import ConvexProbe, LinearProbe, PhasedProbe, RadialProbe, SceneInfo, SteeredProbe, read_header
from ultragray.errors import InvalidArgument, InvalidPose, LowConfidence, SceneFileInvalid
from ultragray.rendering.backends import cpu
from ultragray.scene.confidence import (
    FIGURES,
    POINTS_PER_SIDE,
    SUPPORT_COVERAGE,
    Assessor,
    ConfidenceModel,
    Extrapolation,
    Support,
    TrainingViews,
    ViewMeasures,
    figure_arrays,
    is_confident,
    predicted,
    require_confidence,
    supported,
    terms_of,
)

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


def test_each_figure_is_an_array_and_nan_where_it_is_not_known():
    arrays = figure_arrays([Extrapolation(1.0, 2.0, 0.75, 0.25), Extrapolation(3.0, 4.0, None, None)])
    assert tuple(arrays) == FIGURES == ("distance_mm", "angle_deg", "confidence", "supported_share")
    assert {values.dtype for values in arrays.values()} == {np.dtype(np.float32)}
    np.testing.assert_array_equal(list(arrays.values()), [[1, 3], [2, 4], [0.75, np.nan], [0.25, np.nan]])


NEAR = Extrapolation(0.5, 1.0, 0.8, None)
FAR = Extrapolation(12.34, 5.67, 0.3, None)
UNKNOWN = Extrapolation(None, None, None, 0.5)


def test_the_limit_itself_will_do_and_what_is_not_known_has_none():
    assert is_confident(NEAR, 0.8)
    assert not is_confident(NEAR, 0.81)
    assert is_confident(UNKNOWN, 0.0)
    assert not is_confident(UNKNOWN, 0.01)


def test_the_first_pose_below_the_limit_is_named():
    require_confidence([NEAR, FAR, UNKNOWN], None)
    require_confidence([NEAR, FAR], 0.3)
    with pytest.raises(LowConfidence) as caught:
        require_confidence([NEAR, FAR, FAR], 0.5)
    assert caught.value.field == "poses[1]"
    assert caught.value.detail == (
        "poses[1] has a confidence of 0.30, 0.5 is asked for: the nearest training views are 12.3 mm and 5.7 degrees "
        "away"
    )
    with pytest.raises(LowConfidence, match=r"0\.5 is asked for; Gaussians support 50% of its pixels$"):
        require_confidence([UNKNOWN], 0.5)


FITTED = ConfidenceModel(
    weights=(3.5, 1.2, 0.8, 0.1, 0.6),
    black_ms_ssim=0.06,
    hardness=(0.0, 1.0),
    fitted_on=20,
    error=0.04,
    support=Support(1.5, 0.9, 4.0),
    fitted_to_mm=2.0,
)


def measures(distance_mm=0.0, interpolation_mm=0.0, angle_deg=0.0, weight=0.0):
    """`weight`: of the harder of two views."""
    values = (np.array([[value]]) for value in (distance_mm, distance_mm, interpolation_mm, angle_deg))
    return ViewMeasures(*values, weights=np.array([[1.0 - weight, weight]]))


def test_the_formula():
    at_a_view = 0.06 + 0.94 / (1.0 + np.exp(-3.5))
    assert FITTED.predict(measures()) == pytest.approx([at_a_view])
    away = 3.5 - 1.2 * np.log(1.0 + 0.9 / 0.3) - 0.8 * 2.0 / 5.0 - 0.1 * 5.0 / 10.0 - 0.6 * 0.25
    expected = 0.06 + 0.94 / (1.0 + np.exp(-away))
    assert FITTED.predict(measures(2.0, 0.9, 5.0, 0.25)) == pytest.approx([expected])


@pytest.mark.parametrize("fitted_to_mm", [2.0, None])
def test_the_kernel_predicts_by_the_formula_that_is_fitted(fitted_to_mm):
    rng = np.random.default_rng(0)
    distance_mm, interpolation_mm, angle_deg = rng.uniform(0.0, 8.0, (3, 5, 36))
    weights = rng.dirichlet([1.0, 1.0], 5)
    at = ViewMeasures(distance_mm, distance_mm, interpolation_mm, angle_deg, weights)
    model = replace(FITTED, support=None, fitted_to_mm=fitted_to_mm)
    fitted = predicted(np.array(model.weights), terms_of(at, np.array(model.hardness), fitted_to_mm), 0.06)
    np.testing.assert_allclose(model.predict(at), fitted, rtol=1e-12)


def test_distance_beyond_what_it_was_fitted_on_counts_twice():
    ending = replace(FITTED, support=None)
    endless = replace(ending, fitted_to_mm=None)
    assert ending.predict(measures(3.0)) == pytest.approx(endless.predict(measures(4.0)))
    assert ending.predict(measures(2.0)) == pytest.approx(endless.predict(measures(2.0)))


def test_little_support_limits_the_confidence():
    told = [FITTED.limited(confidence, share) for confidence, share in ((0.8, 0.2), (0.2, 0.2), (0.99, 0.7))]
    assert told == pytest.approx([0.06 + 0.94 * 1.5 * 0.2, 0.2, 0.99])
    assert replace(FITTED, support=None).limited(0.8, 0.0) == 0.8


def test_a_pose_alone_is_taken_to_have_the_support_of_its_distance():
    least = replace(FITTED, weights=(9.0, 0.0, 0.0, 0.0, 0.0))  # that would be sure of everything
    assert least.predict(measures(0.0)) == pytest.approx([0.06 + 0.94 / (1.0 + np.exp(-9.0))])
    assert least.predict(measures(6.0)) == pytest.approx([0.06 + 0.94 * 1.5 * 0.9 * np.exp(-((6.0 / 4.0) ** 2))])


def test_json_and_back():
    for model in (FITTED, replace(FITTED, support=None, fitted_to_mm=None)):
        document = json.loads(json.dumps(model.to_dict(), allow_nan=False))
        assert document["version"] == 2
        assert ConfidenceModel.from_dict(document) == model


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"version": 3}, "version 2, got 3"),
        ({"support": {"gain": 0.0, "share": 0.5, "reach_mm": 1.0}}, "support must be positive"),
        ({"fitted_to_mm": -1.0}, "fitted_to_mm must be 1 numbers, at least 0"),
        ({"weights": [1.0, -2.0, 0, 0, 0]}, "at least 0"),
        ({"weights": [float("nan")] * 5}, "weights must be finite"),
        ({"black_ms_ssim": 1.5}, r"in \[0, 1\], got 1.5"),
        ({"fitted_on": 0}, "fitted_on must be an integer of at least 1"),
        ({"more": 1}, "with the keys"),
    ],
)
def test_damage_is_refused(change, said):
    with pytest.raises(InvalidArgument, match=said):
        ConfidenceModel.from_dict({**FITTED.to_dict(), **change})


CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=40.0, far_mm=120.0)
PHASED = PhasedProbe(opening_angle_deg=80.0, far_mm=100.0)
RADIAL = RadialProbe(near_mm=2.0, far_mm=30.0)
STEERED = SteeredProbe(width_mm=40.0, steering_deg=-25.0, near_mm=5.0, far_mm=50.0)


def tilted(angle_deg):
    """About x, the probe's lateral axis."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    pose = np.eye(4)
    pose[1:3, 1:3] = [[c, -s], [s, c]]
    return pose[None]


def in_plane(angle_deg):
    """About y, so that the image plane stays."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    pose = np.eye(4)
    pose[0, 0], pose[0, 2], pose[2, 0], pose[2, 2] = c, s, -s, c
    return pose[None]


def averaged(measures):
    """The same with the mean over the points as the only one."""
    names = ("nearest_mm", "distance_mm", "interpolation_mm", "angle_deg")
    means = {name: getattr(measures, name).mean(axis=1, keepdims=True) for name in names}
    return replace(measures, **means)


@pytest.mark.parametrize(
    ("at_mm", "distance_mm", "interpolation_mm"),
    [(0.0, 0.0, 0.0), (2.0, 2.0, 1.0), (1.0, 1.0, 0.75), (7.0, 3.0, 3.0), (-5.0, 5.0, 5.0), (104.0, 20.0, 20.0)],
)
def test_between_two_views_counts_half_and_beyond_them_all(at_mm, distance_mm, interpolation_mm):
    measured = averaged(TrainingViews(moved(0.0, 4.0), PROBE).measure(moved(at_mm), PROBE))
    assert measured.distance_mm[0] == pytest.approx([distance_mm], abs=1e-5)
    assert measured.interpolation_mm[0] == pytest.approx([interpolation_mm], rel=1e-3, abs=1e-5)
    assert measured.nearest_mm[0] == pytest.approx([min(abs(at_mm), abs(at_mm - 4.0))], abs=1e-5)


def test_a_view_of_a_probe_that_was_turned_round_is_on_the_same_side():
    views = moved(0.0, 4.0)
    views[1, :3, :3] = np.diag([-1.0, -1.0, 1.0])
    measured = averaged(TrainingViews(views, PROBE).measure(moved(2.0), PROBE))
    assert measured.interpolation_mm[0] == pytest.approx([1.0])


@pytest.mark.parametrize("probe", [PROBE, CONVEX, PHASED, RADIAL, STEERED])
def test_distance_to_an_image_and_not_to_its_plane(probe):
    pose = tilted(12.0)
    pose[0, :3, 3] = (15.0, 4.0, 9.0)
    measured = averaged(TrainingViews(np.eye(4)[None], probe).measure(pose, probe))
    lines, rows = 400, 400
    origins, directions = probe.scan_lines(lines)
    image = (origins + probe.depths_mm(rows)[:, None, None] * directions).reshape(-1, 3)
    origins, directions = probe.scan_lines(POINTS_PER_SIDE)
    points = (origins + probe.depths_mm(POINTS_PER_SIDE)[:, None, None] * directions).reshape(-1, 3)
    points = points @ pose[0, :3, :3].T + pose[0, :3, 3]
    exact = [float(np.sqrt(np.square(image - point).sum(axis=1).min())) for point in points]
    assert measured.nearest_mm[0, 0] == pytest.approx(np.mean(exact), rel=0.02)


def test_angle_is_the_rotation_to_the_nearest_view():
    views = np.concatenate([np.eye(4)[None], moved(60.0)])
    measured = averaged(TrainingViews(views, PROBE).measure(tilted(7.0), PROBE))
    assert measured.angle_deg[0] == pytest.approx([7.0])


def test_of_two_views_as_near_the_less_turned_is_the_nearest():
    views = np.concatenate([in_plane(20.0), in_plane(5.0)])
    (angle_deg,) = averaged(TrainingViews(views, PROBE).measure(np.eye(4)[None], PROBE)).angle_deg
    assert 5.0 - 1e-6 <= angle_deg < 8.0  # the corners of the image lie in neither


def test_weights_are_those_of_the_views_around():
    views = TrainingViews(moved(0.0, 2.0, 30.0), PROBE)
    near, far = views.measure(moved(0.0, 60.0), PROBE).weights
    assert near.sum() == pytest.approx(1.0)
    assert near[0] > near[1] > 100 * near[2]
    assert far.argmax() == 2


@pytest.mark.parametrize("probe", [PROBE, CONVEX, PHASED, RADIAL, STEERED])
@pytest.mark.parametrize("instruction_set", cpu.INSTRUCTION_SETS)
def test_the_kernel_measures_as_it_is_defined(probe, instruction_set):
    """Point by point and view by view, in double precision."""
    rng = np.random.default_rng(0)
    views, asked = (moved(*rng.normal(0.0, 10.0, count)) for count in (37, 3))
    for pose in (*views, *asked):
        pose[:3, :3] = Rotation.from_rotvec(rng.normal(0.0, 1.0, 3)).as_matrix()
    training = TrainingViews(views, probe, instruction_set=instruction_set)
    measured = training.measure(asked, probe)
    middle, reach = (probe.near_mm + probe.far_mm) / 2, probe.scan_line_length_mm / 2
    rows, columns = np.meshgrid((np.arange(6) + 0.5) / 6, (np.arange(6) + 0.5) / 6, indexing="ij")
    points = probe.points_mm(rows, columns).reshape(-1, 3)
    _, slope, scale, across, half, _ = probe.lines.edges
    for c, pose in enumerate(asked):
        turned = np.array(
            [np.degrees(Rotation.from_matrix(view[:3, :3].T @ pose[:3, :3]).magnitude()) for view in views]
        )
        squares = np.zeros(len(views))
        for k, point in enumerate(points @ pose[:3, :3].T + pose[:3, 3]):
            x, y, z = ((point - views[:, :3, 3])[:, None] @ views[:, :3, :3])[:, 0].T
            depth = np.hypot(x, z) if probe.lines.edges.fanned else z * probe.lines.edges.by_z
            lateral = np.maximum(scale * np.abs(x - slope * z) - across * z - half, 0.0)
            away = np.sqrt(y**2 + lateral**2 + np.maximum(np.abs(depth - middle) - reach, 0.0) ** 2)
            front = y * (views[:, :3, 1] @ pose[:3, 1]) >= 0.0
            before, behind = (away[side].min(initial=2e4) for side in (front, ~front))
            nearest = np.argmin(away + 0.02 * turned)
            assert measured.nearest_mm[c, k] == pytest.approx(away[nearest], abs=1e-4)
            assert measured.angle_deg[c, k] == pytest.approx(turned[nearest], abs=1e-3)
            between = before * behind / (before + behind)
            assert measured.interpolation_mm[c, k] == pytest.approx(min(between, 20.0), abs=1e-4)
            squares += away**2
        around = np.sqrt(squares / len(points))
        np.testing.assert_allclose(training.mean_distances_mm(pose[None], probe)[0], around, rtol=1e-5)

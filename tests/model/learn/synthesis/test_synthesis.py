"""Scenes from labels: bodies lie where the map says, sound is lost as theory has it, and nothing counts as recorded."""

import base64
import math

import numpy as np
import pytest
import trimesh

from ultragray import GaussianScene, LinearProbe, render
from ultragray.errors import InvalidArgument
from ultragray.geometry.probe import ConvexProbe
from ultragray.learn.synthesis.scene import SPACING, opacity_of, scene_from_labels, surface_mm, turned
from ultragray.rendering.frames import render_shown
from ultragray.rendering.settings import Encoding, FrameSettings
from ultragray.scene.label_maps import read_label_map
from ultragray.scene.recipes import SceneRecipe, TissueBody, read_recipe
from ultragray.scene.shapes import BoxShape, MeshShape, SphereShape, TubeShape
from ultragray.scene.tissues import WHOLE_REFLECTION_DB

PROBE = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)
VIEW = {"towards": (0.0, 0.0, 1.0), "along": (0.0, 1.0, 0.0), "probe": PROBE, "sweep_mm": 12.0, "pose_count": 13}
SMALL = {**VIEW, "gaussian_count": 12_000, "image_size": 96}
BLOCK = BoxShape(min_mm=(-20.0, -12.0, 0.0), max_mm=(20.0, 12.0, 45.0))


def nrrd(labels: np.ndarray, origin=(0.0, 0.0, 0.0), spacing=1.0) -> bytes:
    header = [
        *("NRRD0005", "type: uint8", "dimension: 3", "space: left-posterior-superior", "encoding: raw"),
        f"sizes: {' '.join(map(str, labels.shape))}",
        f"space directions: (-{spacing},0,0) (0,-{spacing},0) (0,0,{spacing})",
        f"space origin: ({-origin[0]},{-origin[1]},{origin[2]})",
    ]
    return "\n".join(header).encode() + b"\n\n" + labels.tobytes(order="F")


@pytest.fixture(scope="module")
def block() -> GaussianScene:
    bodies = (
        TissueBody(tissue="liver", shape=BLOCK),
        TissueBody(tissue="blood", shape=TubeShape(points_mm=((-7.0, -12.0, 20.0), (-7.0, 12.0, 20.0)), radius_mm=3.0)),
        TissueBody(tissue="bone", shape=TubeShape(points_mm=((7.0, -12.0, 14.0), (7.0, 12.0, 14.0)), radius_mm=3.0)),
    )
    return scene_from_labels(SceneRecipe(bodies=bodies, **SMALL, seed=3))


def frame(scene: GaussianScene, name: str) -> np.ndarray:  # [H, W], 4 by 3.2 pixels a mm
    middle = scene.training_poses[len(scene.training_poses) // 2]
    return render(scene, None, middle, height=160, width=96, outputs=(name,))[name][0].numpy()


def test_vessels_are_dark_bone_shadows_and_its_near_surface_is_the_brightest(block):
    shown = frame(block, "bmode")
    column, row = (lambda x: int((x + 15.0) * 3.2)), (lambda z: int(z * 4.0))
    liver = shown[row(8) : row(10), column(-2) : column(2)].mean()
    assert (
        shown[row(19) : row(21), column(-8) : column(-6)].mean() < 0.35 * liver
    )  # these Gaussians are half as large as it
    assert shown[row(26) : row(36), column(6) : column(8)].mean() < 0.1 * liver
    assert frame(block, "transmittance")[row(30), column(7)] < 0.06
    assert frame(block, "transmittance")[row(30), column(-7)] > 0.95
    surface = shown[row(10) : row(12), column(6) : column(8)].max()
    assert surface > 1.8 * liver
    assert surface > shown[row(16) : row(18), column(6) : column(8)].max()


def test_labels_lie_where_bodies_do(block):
    labels, names = frame(block, "labels"), block.info.label_names
    origins, _ = PROBE.scan_lines(96)
    x, z = np.meshgrid(origins[:, 0], PROBE.depths_mm(160))
    vessel = np.hypot(x + 7.0, z - 20.0)
    found = labels == next(number for number, name in names.items() if name == "blood")
    wrong = found != (vessel < 3.0)
    assert np.abs(vessel - 3.0)[wrong].max() < 0.6


def test_nothing_of_it_counts_as_recorded(block):
    assert set(block.info.made_labels) == set(block.info.label_names)
    assert block.info.provenance["edits"][0]["kind"] == "from_labels"
    assert not block.info.confidence


def test_the_same_recipe_makes_the_same_scene_and_another_seed_another():
    recipe = SceneRecipe(bodies=(TissueBody(tissue="liver", shape=BLOCK),), **{**SMALL, "gaussian_count": 1_500})
    first, again = (scene_from_labels(recipe).to_bytes() for _ in range(2))
    assert first == again
    other = SceneRecipe(bodies=recipe.bodies, **{**SMALL, "gaussian_count": 1_500}, seed=1)
    assert scene_from_labels(other).to_bytes() != first


@pytest.mark.parametrize(("attenuation", "frequency_mhz"), [(0.9, 5.0), (0.8, 3.5), (0.34, 5.0)])
def test_attenuation_has_the_slope_of_theory(attenuation, frequency_mhz):
    body = TissueBody(tissue="liver", shape=BLOCK, attenuation=attenuation)
    settings = {**SMALL, "frequency_mhz": frequency_mhz, "level": 0.5, "gaussian_count": 4_000}
    scene = scene_from_labels(SceneRecipe(bodies=(body,), **settings))
    shown = frame(scene, "bmode")[:, 24:72].mean(axis=1)
    depths = PROBE.depths_mm(160)
    inner = (depths > 4.0) & (depths < 30.0)
    slope = 10.0 * 60.0 * np.polyfit(depths[inner], shown[inner], 1)[0]  # dB/cm
    assert slope == pytest.approx(-2.0 * frequency_mhz * (attenuation - 0.54), rel=0.1)


def test_speckle_has_the_statistics_of_theory():
    body = TissueBody(tissue="liver", shape=BLOCK, attenuation=0.54)
    scene = scene_from_labels(SceneRecipe(bodies=(body,), **{**SMALL, "level": 0.6, "gaussian_count": 4_000}))
    settings = FrameSettings(height=320, width=240, speckle="natural").resolved(scene.info, Encoding.FLOAT32)
    level = render_shown(scene, settings, scene.training_poses)["bmode"].numpy()[:, 40:280, 20:220]
    amplitude = 10.0 ** (level * 60.0 / 20.0)  # of a Rayleigh distribution: mean over deviation is 1.91
    ratio = amplitude.mean(axis=(0, 1, 2)) / amplitude.std(axis=(0, 1, 2))
    assert ratio == pytest.approx(math.sqrt(math.pi / (4.0 - math.pi)), rel=0.1)
    assert (60.0 * level).std() == pytest.approx(5.57, rel=0.1)


@pytest.mark.parametrize("contrast_db", [8.0, 16.0, 28.0])
def test_a_surface_shows_what_it_reflects_as_wide_as_its_pulse_in_decibels_and_nothing_along_the_beam(contrast_db):
    share = 10.0 ** ((contrast_db - WHOLE_REFLECTION_DB) / 20.0)
    tissue = {"tissue": "liver", "attenuation": 0.54}
    ball = SphereShape(centre_mm=(0.0, 0.0, 80.0), radius_mm=60.0)
    bodies = (
        TissueBody(**tissue, impedance=1.6, shape=BLOCK),
        TissueBody(**tissue, impedance=1.6 * (1.0 + share) / (1.0 - share), name="ball", shape=ball),
    )
    recipe = SceneRecipe(bodies=bodies, **{**SMALL, "level": 0.3})
    scene = scene_from_labels(recipe)
    rows, half = 1600, 160  # 40 rows a mm
    middle = scene.training_poses[len(scene.training_poses) // 2]
    shown = render(scene, None, middle, height=rows, width=96)["bmode"][0].numpy()
    tops = np.rint((80.0 - np.sqrt(60.0**2 - PROBE.scan_lines(96)[0][16:80, 0] ** 2)) * 40.0).astype(int)
    profiles = [shown[top - half : top + half, 16 + column] for column, top in enumerate(tops)]
    raised = np.array(profiles) - np.mean([(one[:40], one[-40:]) for one in profiles])
    contrast = contrast_db / recipe.dynamic_range_db
    assert raised.max(axis=1).mean() == pytest.approx(contrast, rel=0.1)
    area_mm = raised[:, half - 40 : half + 40].mean(axis=0).sum() / 40.0
    expected_mm = math.sqrt(2.0 * math.pi) * float(surface_mm(recipe, np.array(contrast_db)))
    assert area_mm == pytest.approx(contrast * expected_mm, rel=0.35)
    along = middle.copy()  # from the side: in the middle of its scan lines the beam meets the top of the ball
    along[:3, :3] = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    along[:3, 3] = [20.0, middle[1, 3], 20.0]
    across = render(scene, None, along, height=160, width=300)["bmode"][0, 70:90].mean(dim=0).numpy()
    assert np.abs(across[130:170] - across[[90, 210]].mean()).max() < 0.05


def test_a_layer_of_not_quite_two_cubes_is_shown():
    layer = BoxShape(min_mm=(-20.0, -12.0, 10.0), max_mm=(20.0, 12.0, 12.4))
    tissue = {"tissue": "liver", "attenuation": 0.54, "impedance": 1.6}
    bodies = (TissueBody(**tissue, shape=BLOCK), TissueBody(**tissue, name="layer", echo_db=15.0, shape=layer))
    scene = scene_from_labels(SceneRecipe(bodies=bodies, **{**SMALL, "level": 0.4, "gaussian_count": 4_000}))
    shown = frame(scene, "bmode")[:, 16:80].mean(axis=1)
    assert shown[41:49].mean() - shown[28:34].mean() > 0.4 * 15.0 / 60.0


def test_opacity_takes_as_much_of_a_beam_as_asked_for():
    rates, spacing = np.array([0.0, 0.5, 3.0]), 0.1
    found = opacity_of(rates, spacing)
    assert found[0] == 0.0
    assert np.all(np.diff(found) > 0.0)
    first_order = 1.153 * (2.0 * math.pi) ** 1.5 / SPACING**3  # of 1 − τ and of ψ
    assert rates[1] / found[1] == pytest.approx(first_order, rel=0.2)


def test_directions_turn_by_the_least_rotation():
    before, after = np.array([[0.0, 0.0, 1.0]]), np.array([[0.6, 0.0, 0.8]])
    np.testing.assert_allclose(turned(before, before, after), after, atol=1e-12)
    np.testing.assert_allclose(turned(np.array([[0.0, 1.0, 0.0]]), before, after), [[0.0, 1.0, 0.0]], atol=1e-12)


def test_a_label_map_its_ct_and_a_mesh_make_one_scene(tmp_path):
    labels = np.zeros((40, 24, 46), np.uint8)
    labels[8:30, 4:20, 12:40] = 7
    place = {"origin": (-20.0, -12.0, -1.0)}
    (tmp_path / "labels.nrrd").write_bytes(nrrd(labels, **place))
    volume, affine = read_label_map(tmp_path / "labels.nrrd")
    assert np.array_equal(volume, labels)
    np.testing.assert_allclose(affine[:3, 3], place["origin"])
    np.testing.assert_allclose(np.diag(affine), 1.0)
    import nibabel

    units = np.full(labels.shape, -1000, np.int16)  # air around
    units[1:-1, 1:-1, 1:] = 40
    units[20:24, 8:14, 30:34] = 700
    nibabel.save(nibabel.Nifti1Image(units, affine), tmp_path / "ct.nii.gz")
    trimesh.creation.icosphere(radius=4.0).apply_translation((0.0, 0.0, 20.0)).export(tmp_path / "ball.stl")
    (tmp_path / "tissue.toml").write_text(
        '[[bodies]]\nlabel = 7\ntissue = "liver"\n'
        '[[bodies]]\ntissue = "cyst"\nname = "ball"\nshape = { kind = "mesh", file = "ball.stl" }\n'
    )
    files = tmp_path / "tissue.toml", tmp_path / "labels.nrrd", tmp_path / "ct.nii.gz"
    scene = scene_from_labels(read_recipe(*files, **SMALL))
    assert set(scene.info.label_names.values()) == {"liver", "ball", "muscle"}
    told = scene.info.provenance["edits"][0]
    assert told["label_map"].startswith("sha256:")
    assert told["bodies"][1]["shape"]["data"].startswith("sha256:")


@pytest.mark.parametrize(
    ("bodies", "settings", "field"),
    [
        ([], {}, "bodies"),
        ([{"tissue": "liver"}], {}, "label"),
        ([{"tissue": "cheese", "label": 1}], {}, "tissue"),
        ([{"tissue": "liver", "label": 1}], {}, "label_map"),
        ([{"tissue": "liver", "shape": BLOCK}], {"along": (0.0, 0.0, 1.0)}, "towards"),
        ([{"tissue": "liver", "shape": BLOCK}], {"sweep_mm": 100.0}, "sweep_mm"),
        (
            [{"tissue": "liver", "label": 3}],
            {"label_map": base64.b64encode(nrrd(np.zeros((3, 3, 3), np.uint8))).decode(), "label_map_format": "nrrd"},
            "bodies",
        ),
        ([{"tissue": "liver", "label": 3}], {"label_map": "bm9uZQ==", "label_map_format": "nrrd"}, "label_map"),
    ],
)
def test_recipes_that_cannot_be_made_say_which_field_is_to_blame(bodies, settings, field):
    with pytest.raises(InvalidArgument) as told:
        scene_from_labels(SceneRecipe(bodies=tuple(TissueBody(**body) for body in bodies), **{**SMALL, **settings}))
    assert field in told.value.field


def test_a_convex_probe_stands_on_the_skin_of_what_its_beam_meets():
    body = TissueBody(tissue="liver", shape=SphereShape(centre_mm=(0.0, 0.0, 30.0), radius_mm=25.0))
    probe = ConvexProbe(opening_angle_deg=60.0, near_mm=30.0, far_mm=70.0)
    scene = scene_from_labels(
        SceneRecipe(bodies=(body,), **{**SMALL, "probe": probe, "sweep_mm": 0.0, "pose_count": 1})
    )
    np.testing.assert_allclose(scene.training_poses[0, :3, 3], (0.0, 0.0, 5.0 - 30.0), atol=0.6)


def test_meshes_are_bodies_too():
    mesh = trimesh.creation.box(extents=(8.0, 8.0, 8.0)).apply_translation((0.0, 0.0, 20.0))
    shape = MeshShape(data=base64.b64encode(mesh.export(file_type="stl")).decode(), format="stl")
    bodies = (TissueBody(tissue="liver", shape=BLOCK), TissueBody(tissue="cyst", shape=shape))
    scene = scene_from_labels(SceneRecipe(bodies=bodies, **{**SMALL, "gaussian_count": 6_000}))
    shown = frame(scene, "bmode")
    assert shown[76:84, 44:52].mean() < 0.35 * shown[40:48, 44:52].mean()

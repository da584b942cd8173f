"""Export to the released format: what its code loads, where its code puts it, and back to the same frames."""

import json
from collections import OrderedDict
from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import ConvexProbe, ElevationBeam, GaussianScene, LinearProbe, PhasedProbe, SceneInfo, render
from ultragray.errors import InvalidArgument
from ultragray.exchange.checkpoint import export_checkpoint, fit_released_intensity, import_checkpoint
from ultragray.rendering.backends.reference import intensity
from ultragray.scene.gaussians import PARAMETERS

LINEAR = LinearProbe(width_mm=30.0, near_mm=5.0, far_mm=46.0)
CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=10.0, far_mm=50.0)
PHASED = PhasedProbe(opening_angle_deg=80.0, far_mm=50.0)
HEIGHT, WIDTH = 18, 14


@pytest.fixture
def make_scene(random_scene, random_poses):
    """A scene whose centre is the mean image corner on OUR depth grid, as our trainer places it."""

    def make(probe=LINEAR, *, poses=4, **options):
        training_poses = random_poses(poses, seed=2) + np.array([[0, 0, 0, 120.0], [0] * 4, [0, 0, 0, -40.0], [0] * 4])
        centre = np.array([120.0, 0.0, -20.0])
        if probe is not None and poses:
            corners = np.einsum("pij,cj->pci", training_poses[:, :3, :3], probe.corners_mm())
            centre = (corners + training_poses[:, None, :3, 3]).mean(axis=(0, 1))
        info = SceneInfo(
            centre_mm=tuple(centre),
            probe=probe,
            image_height=HEIGHT,
            image_width=WIDTH,
            intensity=options.pop("intensity", "released"),
            training={"step": 399},
        )
        splats = random_scene(150, centre_cm=(0.0, 0.0, 0.0), **options).splats
        return GaussianScene.from_splats(splats, info=info, training_poses=training_poses)

    return make


def reimported(checkpoint, **options):
    folder = checkpoint.parent
    return import_checkpoint(
        checkpoint, config=folder / "conf.json", **(options or {"poses": folder / "poses_train.npy"})
    )


def bmode(scene, poses=None, *, size=(HEIGHT, WIDTH)):
    poses = scene.training_poses if poses is None else poses
    frames = render(scene, None, poses, height=size[0], width=size[1], outputs=("bmode",), backend="reference")
    assert float(frames.bmode.max()) > 0.05
    return frames.bmode


def test_the_golden_checkpoint_goes_through_us_unchanged(tmp_path, golden_folder, data_folder):
    folder = data_folder / "spine_phantom"
    original = golden_folder / "g06_ckpt_29999.pt"
    scene = import_checkpoint(original, config=folder / "conf.json", poses=folder / "poses_train.npy")
    export = export_checkpoint(scene, tmp_path / "out" / "ckpt_29999.pt")
    assert export.notes == ()
    assert [path.name for path in export.files] == ["conf.json", "poses_train.npy", "ckpt_29999.pt"]
    ours, theirs = (torch.load(path, weights_only=True) for path in (tmp_path / "out" / "ckpt_29999.pt", original))
    assert list(ours) == list(theirs)
    assert (ours["step"], type(ours["step"])) == (29999, int)
    assert list(ours["splats"]) == list(theirs["splats"])
    assert isinstance(ours["splats"], OrderedDict)
    for name, tensor in theirs["splats"].items():
        assert torch.equal(ours["splats"][name], tensor)
        assert (ours["splats"][name].dtype, ours["splats"][name].device) == (tensor.dtype, tensor.device)
    conf, released = (json.loads((path / "conf.json").read_text()) for path in (tmp_path / "out", folder))
    for key in ("ultrasound_near_plane", "ultrasound_far_plane", "ultrasound_opening_width"):
        assert conf[key] == released[key]

    back = reimported(tmp_path / "out" / "ckpt_29999.pt")
    assert back.info.probe == scene.info.probe
    assert (back.info.image_height, back.info.image_width) == (scene.info.image_height, scene.info.image_width)
    np.testing.assert_array_equal(back.training_poses, scene.training_poses)
    before, after = (bmode(s, scene.training_poses[::8], size=(64, 48)) for s in (scene, back))
    assert float((before - after).abs().max()) <= 1e-6


@pytest.mark.parametrize("probe", [LINEAR, CONVEX, PHASED], ids=["linear", "convex", "phased"])
@pytest.mark.parametrize("sh_degree", [0, 1, 3])
def test_the_same_poses_show_the_same(tmp_path, make_scene, probe, sh_degree):
    scene = make_scene(probe, sh_degree=sh_degree)
    export = export_checkpoint(scene, tmp_path / "ckpt.pt")
    back = reimported(tmp_path / "ckpt.pt")
    assert back.info.centre_mm == pytest.approx(export.centre_mm, abs=1e-9)
    moved_mm = np.linalg.norm(np.subtract(export.centre_mm, scene.info.centre_mm))
    assert moved_mm > 0.5  # half a row: what would be off if the Gaussians had not been moved along
    assert (back.sh_degree, back.info.training["step"]) == (sh_degree, 399)
    difference = (bmode(scene) - bmode(back)).abs()
    assert float(difference.quantile(0.999)) <= 2e-5  # a threshold of the model may flip at the last bit of a mean
    assert float(difference.max()) <= 5e-3


def test_a_scene_without_training_poses_is_exported_about_its_centre(tmp_path, make_scene):
    scene = make_scene(poses=0)
    export = export_checkpoint(scene, tmp_path / "ckpt.pt")
    assert sorted(path.name for path in export.files) == ["ckpt.pt", "conf.json"]
    assert any("no training poses" in note and "(120, 0, -20) mm" in note for note in export.notes)
    back = reimported(tmp_path / "ckpt.pt", center_mm=export.centre_mm)
    pose = np.eye(4)
    pose[:3, 3] = (120.0, 0.0, -40.0)
    assert torch.equal(back.means, scene.means)
    torch.testing.assert_close(bmode(back, pose), bmode(scene, pose), atol=2e-5, rtol=0)


def test_a_scene_that_does_not_know_its_probe(tmp_path, make_scene):
    export = export_checkpoint(make_scene(None), tmp_path / "ckpt.pt")
    assert [path.name for path in export.files] == ["ckpt.pt"]
    assert any("does not know its probe" in note for note in export.notes)


def test_a_scene_with_a_beam_is_told_to_be_cut_by_a_plane(tmp_path, make_scene):
    scene = make_scene()
    assert not any("beam" in note for note in export_checkpoint(scene, tmp_path / "a" / "ckpt.pt").notes)
    thick = replace(scene, info=replace(scene.info, beam=ElevationBeam(2.5)))
    assert any("2.5 mm thick" in note for note in export_checkpoint(thick, tmp_path / "b" / "ckpt.pt").notes)


def test_a_sigmoid_scene_is_fitted_and_says_how_well(tmp_path, make_scene):
    scene = make_scene(intensity="sigmoid")
    export = export_checkpoint(scene, tmp_path / "ckpt.pt")
    assert 0.0 < export.largest_intensity_error <= 0.5
    assert any("sigmoid" in note and f"{export.largest_intensity_error:.2f}" in note for note in export.notes)
    back = reimported(tmp_path / "ckpt.pt")
    assert back.info.intensity == "released"
    for name in set(PARAMETERS) - {"sh0", "shN", "means"}:
        assert torch.equal(back.splats[name], scene.splats[name])
    assert not torch.equal(back.sh0, scene.sh0)


def test_nothing_of_a_dataset_is_replaced(tmp_path, make_scene):
    scene = make_scene()
    (tmp_path / "conf.json").write_text("{}")
    with pytest.raises(InvalidArgument, match=r"conf\.json exists and says something else"):
        export_checkpoint(scene, tmp_path / "ckpt.pt")
    assert [path.name for path in tmp_path.iterdir()] == ["conf.json"]
    (tmp_path / "conf.json").unlink()
    for _ in range(2):  # the same again is no replacement
        export_checkpoint(scene, tmp_path / "ckpt.pt")
    np.save(tmp_path / "poses_train.npy", np.eye(4)[None])
    with pytest.raises(InvalidArgument, match=r"poses_train\.npy exists"):
        export_checkpoint(scene, tmp_path / "ckpt.pt")


def test_one_row_has_no_released_grid(tmp_path, random_scene):
    scene = random_scene(3, info={"probe": LINEAR, "image_height": 1})
    with pytest.raises(InvalidArgument, match="at least 2 rows"):
        export_checkpoint(scene, tmp_path / "out" / "ckpt.pt")
    assert not (tmp_path / "out").exists()


def test_every_tensor_has_a_storage_of_its_own(tmp_path, make_scene):
    """A view would drag the whole tensor it looks at into the file."""
    made = make_scene()
    both = torch.cat([made.sh0, made.shN, made.sh0.expand(-1, 500, -1)], dim=1)
    splats = {**made.splats, "sh0": both[:, :1], "shN": both[:, 1:4]}
    export_checkpoint(GaussianScene.from_splats(splats), tmp_path / "ckpt.pt")
    assert (tmp_path / "ckpt.pt").stat().st_size < 20_000
    saved = torch.load(tmp_path / "ckpt.pt", weights_only=True)["splats"]
    assert torch.equal(saved["shN"], made.shN)


def fitted(scene):
    fit = fit_released_intensity(scene)
    splats = {**scene.splats, "sh0": fit.sh0, "shN": fit.shN}
    released = GaussianScene.from_splats(
        splats, info=replace(scene.info, intensity="released"), training_poses=scene.training_poses
    )
    return released, fit.largest_error, fit.mean_error


def errors(scene, released):  # [C, N]
    """What a renderer finds: the intensities of both, seen from each training pose."""
    origins = torch.from_numpy(scene.poses_to_scene_cm(scene.training_poses)[:, :3, 3]).float()
    return torch.stack([(intensity(scene, origin) - intensity(released, origin)).abs() for origin in origins])


@pytest.fixture
def make_sigmoid_scene(random_scene, random_poses):
    def make(sh_degree, *, sh0, spread, poses=6):
        made = random_scene(300, sh_degree=sh_degree, intensity="sigmoid", info={"centre_mm": (1.0, 2.0, 3.0)})
        rng = np.random.default_rng(5)
        splats = {
            **made.splats,
            "sh0": torch.from_numpy(rng.uniform(*sh0, (300, 1, 1)).astype(np.float32)),
            "shN": made.shN * spread,
        }
        return GaussianScene.from_splats(splats, info=made.info, training_poses=random_poses(poses))

    return make


def test_intensities_above_the_floor_fit_exactly_without_directions(make_sigmoid_scene):
    scene = make_sigmoid_scene(0, sh0=(0.1, 5.0), spread=1.0)  # I from 0.53 to 0.996
    released, largest, mean = fitted(scene)
    assert largest < 1e-6
    assert mean <= largest
    assert float(errors(scene, released).max()) < 1e-6


@pytest.mark.parametrize("sh_degree", [1, 2, 3])
def test_directions_fit_where_the_scene_was_seen_from(make_sigmoid_scene, sh_degree):
    scene = make_sigmoid_scene(sh_degree, sh0=(2.0, 3.0), spread=0.5)  # none under the floor
    released, largest, _ = fitted(scene)
    assert largest < 5e-3
    found = errors(scene, released)
    assert float(found.max()) == pytest.approx(largest, abs=1e-5)
    constant = replace_sh(released, 0.0)
    assert float(found.mean()) < 0.2 * float(errors(scene, constant).mean())


def replace_sh(scene, factor):
    return GaussianScene.from_splats({**scene.splats, "shN": scene.shN * factor}, info=scene.info)


def test_what_lies_under_the_floor_is_told(make_sigmoid_scene):
    scene = make_sigmoid_scene(1, sh0=(-5.0, -3.0), spread=0.0)  # I from 0.0035 to 0.033
    released, largest, mean = fitted(scene)
    found = errors(scene, released)
    assert largest == pytest.approx(float(found.max()), abs=1e-5)
    assert mean == pytest.approx(float(found.mean()), abs=1e-5)
    assert 0.46 < mean <= largest < 0.5

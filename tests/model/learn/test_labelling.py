"""Labels of Gaussians from painted frames and from label maps, held against the tissue of the phantom."""

from dataclasses import replace

import nibabel
import numpy as np
import pytest
import torch

from ultragray import GaussianScene, render
from ultragray.errors import InvalidArgument
from ultragray.learn.labelling import UNPAINTED, PaintedFrame, label_by_frames, label_by_map, same_but_for_labels
from ultragray.phantom.demo import DEMO_PROBE, LABEL_NAMES, demo_poses, labels_of, load_demo_scene
from ultragray.phantom.imaging import tissues
from ultragray.rendering.volume_fields import write_volume
from ultragray.rendering.volumes import VolumeGrid
from ultragray.scene.label_maps import read_label_map, read_painted

SIDE = 256
BONE, MUSCLE = 1, 2


@pytest.fixture(scope="module")
def labelled_scene():
    return load_demo_scene()


@pytest.fixture(scope="module")
def scene(labelled_scene):
    """The demo scene before somebody labels it."""
    return replace(labelled_scene, labels=None, info=replace(labelled_scene.info, label_names={}))


def shown(scene, poses):  # [C, H, W]
    return render(scene, None, poses, height=SIDE, width=SIDE, outputs=("labels",))["labels"].numpy()


def painted(pose, rows, columns, label):
    labels = np.full((SIDE, SIDE), UNPAINTED, np.uint8)
    labels[rows, columns] = label
    return PaintedFrame(pose, labels)


def dice(scene, poses, truth):
    """By name, over pixels of which the scene knows something: with support, and not in shadow."""
    frames = render(scene, None, poses, height=SIDE, width=SIDE, outputs=("labels", "coverage", "transmittance"))
    known = ((frames["coverage"] > 0.3) & (frames["transmittance"] > 0.1)).numpy()
    found = frames["labels"].numpy()
    return {
        name: 2 * ((found == label) & (truth == label) & known).sum()
        / (((found == label) & known).sum() + ((truth == label) & known).sum())
        for label, name in LABEL_NAMES.items()
    }  # fmt: skip


def test_three_painted_frames_label_those_between_them_nearly_as_well_as_the_tissue_itself(scene, labelled_scene):
    poses = demo_poses(25)  # 3 mm apart
    truth = labels_of(tissues(poses, probe=DEMO_PROBE, height=SIDE, width=SIDE))
    given, held_out = [8, 12, 16], [9, 10, 11, 13, 14, 15]
    frames = [PaintedFrame(poses[index], truth[index]) for index in given]

    alone = dice(label_by_frames(scene, frames, names=LABEL_NAMES), poses[held_out], truth[held_out])
    spread = dice(label_by_frames(scene, frames, names=LABEL_NAMES, within_mm=4.0), poses[held_out], truth[held_out])
    best = dice(labelled_scene, poses[held_out], truth[held_out])
    assert spread["muscle"] > 0.96
    assert spread["fat"] > 0.92
    assert spread["bone"] > 0.72
    assert spread["vessel"] > 0.68
    assert all(spread[name] > alone[name] for name in best)
    assert all(spread[name] > best[name] - 0.08 for name in best)


def test_a_correction_holds_against_what_was_painted_before(scene):
    (pose,), region = demo_poses(1), (slice(60, 120), slice(40, 100))
    wrong = painted(pose, *region, BONE)
    right = painted(pose, *region, MUSCLE)
    names = {BONE: "bone", MUSCLE: "muscle"}
    middle = (0, slice(70, 110), slice(50, 90))
    assert (shown(label_by_frames(scene, [wrong], names=names), pose)[middle] == BONE).mean() > 0.98
    corrected = label_by_frames(scene, [wrong, right], names=names)
    assert (shown(corrected, pose)[middle] == MUSCLE).mean() > 0.98
    again = label_by_frames(scene, [wrong, right, wrong], names=names)
    assert (shown(again, pose)[middle] == BONE).mean() > 0.98
    erased = label_by_frames(corrected, [painted(pose, *region, 0)], names={})
    assert (shown(erased, pose)[middle] == 0).mean() > 0.98


def test_labels_stay_where_nothing_is_painted_and_go_no_further_than_said(scene):
    (pose,), region = demo_poses(1), (slice(60, 120), slice(40, 100))
    once = label_by_frames(scene, [painted(pose, *region, BONE)], names={BONE: "bone"})
    elsewhere = label_by_frames(
        once, [painted(pose, slice(60, 120), slice(160, 200), MUSCLE)], names={MUSCLE: "muscle"}
    )
    assert elsewhere.info.label_names == {BONE: "bone", MUSCLE: "muscle"}
    assert torch.equal(elsewhere.labels == BONE, once.labels == BONE)
    means_mm = 10 * scene.means
    wide = label_by_frames(scene, [painted(pose, *region, BONE)], names={BONE: "bone"}, within_mm=3.0)
    grown = (wide.labels > 0) & (once.labels == 0)
    assert grown.sum() > 100
    assert not ((wide.labels == 0) & (once.labels > 0)).any()
    assert torch.cdist(means_mm[grown], means_mm[once.labels > 0]).min(dim=1).values.max() <= 3.0


def test_of_a_scene_with_labels_only_the_surroundings_of_what_is_painted_change(labelled_scene):
    (pose,), lesion = demo_poses(1), 5
    frame = painted(pose, slice(60, 120), slice(40, 100), lesion)
    now = label_by_frames(labelled_scene, [frame], names={lesion: "lesion"}, within_mm=4.0).labels
    means_mm, before = 10 * labelled_scene.means, labelled_scene.labels
    voted = label_by_frames(labelled_scene, [frame], names={lesion: "lesion"}).labels == lesion
    changed = now != before
    assert set(now[changed].tolist()) == {lesion}
    assert torch.cdist(means_mm[changed], means_mm[voted]).min(dim=1).values.max() <= 4.0
    assert not (changed & ~voted & (before > 0)).any()


def test_a_brush_beside_a_gaussian_does_not_label_it(scene):
    (pose,) = demo_poses(1)
    once = label_by_frames(scene, [painted(pose, slice(60, 120), slice(40, 100), BONE)], names={BONE: "bone"})
    far = shown(once, pose)[0].copy()
    far[52:128, 32:108] = 0  # 2 mm around the painted region
    assert (far == 0).all()


@pytest.mark.parametrize("moved", [False, True])
def test_a_label_map_gives_each_gaussian_the_label_at_its_place(labelled_scene, scene, tmp_path, moved):
    grid = VolumeGrid.over_scene(labelled_scene.info, None, 1.0)
    write_volume(tmp_path / "map.nii.gz", labelled_scene, "labels", grid)
    to_scene = np.eye(4)
    if moved:  # the map of another scanner, turned and shifted
        to_scene[:3, :3], to_scene[:3, 3] = [[0, 1, 0], [0, 0, 1], [1, 0, 0]], [5, -40, 12]
        image = nibabel.load(tmp_path / "map.nii.gz")
        turned = nibabel.Nifti1Image(np.asanyarray(image.dataobj), np.linalg.inv(to_scene) @ image.affine)
        nibabel.save(turned, tmp_path / "map.nii.gz")
    labelled = label_by_map(
        scene, *read_label_map(tmp_path / "map.nii.gz"), names={BONE: "bone"}, map_to_scene=to_scene
    )
    assert labelled.info.label_names == {1: "bone", 2: "label 2", 3: "label 3", 4: "label 4"}
    is_muscle = labelled_scene.labels == MUSCLE
    assert (labelled.labels[is_muscle] == MUSCLE).float().mean() > 0.9
    assert same_but_for_labels(labelled, labelled_scene)
    labelled.save(tmp_path / "labelled.ugr")
    assert torch.equal(GaussianScene.load(tmp_path / "labelled.ugr").labels, labelled.labels)


def test_what_is_no_label_is_refused(scene, tmp_path):
    (pose,) = demo_poses(1)
    names = {BONE: "bone"}
    region = slice(0, 9), slice(0, 9)
    for field, frames, more in [
        ("frames", [], {}),
        ("label_names", [painted(pose, *region, 7)], {}),
        ("label_names", [painted(pose, *region, BONE)], {"names": {UNPAINTED: "all"}}),
        ("frames[1].labels", [painted(pose, *region, BONE), painted(pose, *region, UNPAINTED)], {}),
        ("frames[0].labels", [PaintedFrame(pose, np.zeros((9, 9)))], {}),
        ("within_mm", [painted(pose, *region, BONE)], {"within_mm": float("nan")}),
    ]:
        with pytest.raises(InvalidArgument) as refused:
            label_by_frames(scene, frames, **{"names": names, **more})
        assert refused.value.field == field
    far = np.eye(4)
    for distance_mm in (1e4, 1e30):
        far[:3, 3] = distance_mm
        with pytest.raises(InvalidArgument, match="is it registered"):
            label_by_map(scene, np.ones((4, 4, 4), np.uint8), far, names=names)

    def file(values):
        path = tmp_path / f"{values.dtype}-{values.ndim}.nii"
        nibabel.save(nibabel.Nifti1Image(values, np.eye(4)), path)
        return path

    (tmp_path / "text.nii").write_text("no volume")
    np.savez(tmp_path / "frames.npz", poses=np.eye(4)[None])
    for path, words in [
        (file(np.full((2, 2, 2), 0.5, np.float32)), "whole numbers"),
        (file(np.full((2, 2, 2), 300, np.int16)), "0 to 255, it holds 300 to 300"),
        (file(np.zeros((2, 2, 2, 2), np.uint8)), "one volume"),
        (tmp_path / "text.nii", "NIfTI"),
        (tmp_path / "no.nii", "NIfTI"),
        (tmp_path / "map.png", "must end in"),
    ]:
        with pytest.raises(InvalidArgument, match=words):
            read_label_map(path)
    (tmp_path / "cut.npz").write_bytes((tmp_path / "frames.npz").read_bytes()[:-40])
    for path, words in [("frames.npz", "labels"), ("cut.npz", "poses and labels"), ("map.png", "must end in")]:
        with pytest.raises(InvalidArgument, match=words):
            read_painted(tmp_path / path)
    for labels in (["a"], [np.nan], [0.5], [-1], [256], [[1], [1]]):
        np.savez(tmp_path / "frames.npz", poses=np.eye(4)[None], labels=np.array(labels).reshape(len(labels), 1, 1))
        with pytest.raises(InvalidArgument, match="whole numbers"):
            read_painted(tmp_path / "frames.npz")


def test_a_label_map_in_metres_is_read_in_millimetres_and_one_without_a_place_is_refused(tmp_path):
    affine = np.array([[2.0, 0.0, 0.0, -30.0], [0.0, 0.0, 3.0, 20.0], [0.0, 4.0, 0.0, 5.0], [0.0, 0.0, 0.0, 1.0]])
    for unit, per_mm in (("mm", 1.0), ("meter", 1e-3), ("micron", 1e3)):
        image = nibabel.Nifti1Image(np.ones((2, 3, 4), np.uint8), np.diag([per_mm, per_mm, per_mm, 1.0]) @ affine)
        image.header.set_xyzt_units(unit)
        nibabel.save(image, tmp_path / "map.nii")
        np.testing.assert_allclose(read_label_map(tmp_path / "map.nii").affine, affine, rtol=1e-6)
    image.header["qform_code"] = image.header["sform_code"] = 0
    image.header.set_xyzt_units("mm")
    nibabel.save(nibabel.Nifti1Image(image.dataobj, None, image.header), tmp_path / "map.nii")
    with pytest.raises(InvalidArgument, match="which side is left"):
        read_label_map(tmp_path / "map.nii")
    head = (
        "NRRD0004\ntype: uchar\ndimension: 3\nspace: left-posterior-superior\nsizes: 1 1 1\nencoding: raw\n"
        'space directions: (1,0,0) (0,1,0) (0,0,1)\nspace origin: (0,0,0)\nspace units: "m" "m" "m"\n\n'
    )
    (tmp_path / "map.nrrd").write_bytes(head.encode() + b"\1")
    with pytest.raises(InvalidArgument, match="space units must be mm, they are m"):
        read_label_map(tmp_path / "map.nrrd")

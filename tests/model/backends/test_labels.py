"""Labels: what each backend says lies at a pixel, against sums over all Gaussians in float64; files that carry them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import GaussianScene, LinearProbe, SceneInfo, read_header, render
from ultragray.errors import InvalidArgument, SceneFileInvalid, UnknownOutput
from ultragray.exchange.checkpoint import export_checkpoint
from ultragray.exchange.ply import read_ply, write_ply
from ultragray.learn.sweep import pixel_positions_mm

from ..weights import gaussian_weights
from .conftest import CONVEX, HEIGHT, LINEAR, PHASED, WIDTH

PROBES = {"linear": LINEAR, "convex": CONVEX, "phased": PHASED}
BACKENDS = ("reference", "cpu", "cuda")
NAMES = {1: "bone", 2: "muscle", 9: "vessel"}
SEEN = 1.0 / 255.0


@pytest.fixture
def labelled(random_scene):
    """A random scene whose Gaussians carry 0, 1, 2 or 9."""

    def make(count=200, *, names=None, **options):
        scene = random_scene(count, **options)
        values = np.random.default_rng(5).choice([0, 1, 2, 9], count).astype(np.uint8)
        info = SceneInfo(intensity=scene.info.intensity, label_names=NAMES if names is None else names)
        return GaussianScene.from_splats(scene.splats, info=info, labels=torch.from_numpy(values))

    return make


@pytest.fixture(params=BACKENDS)
def renderer(request, on_device):
    if request.param == "cuda":
        return lambda scene, *view, **size: render(on_device(scene), *view, backend="cuda", **size)
    return lambda scene, *view, **size: render(scene, *view, backend=request.param, **size)


def label_frames(frames):  # [C, H, W]
    assert frames.labels.dtype == torch.uint8
    return frames.labels.cpu().numpy()


def weights(scene, probe, pose):  # [4, 4] mm -> [N, H·W]
    """w of every Gaussian at every pixel, where it is not culled."""
    points = (pixel_positions_mm(probe, HEIGHT, WIDTH) @ pose[:3, :3].T + pose[:3, 3]) / 10.0
    own = (10.0 * scene.means.double().numpy() - pose[:3, 3]) @ pose[:3, :3]  # mm, probe frame
    depth = own[:, 2] if isinstance(probe, LinearProbe) else np.hypot(own[:, 0], own[:, 2])
    seen = (depth >= probe.near_mm) & (depth <= probe.cull_far_mm(HEIGHT)) & (own[:, 2] >= 0)
    return gaussian_weights(scene, points) * seen[:, None]


@pytest.mark.parametrize("name", PROBES)
def test_the_label_that_weighs_most_is_shown(name, renderer, labelled, random_poses):
    scene, poses, probe = labelled(), random_poses(1), PROBES[name]
    found = label_frames(renderer(scene, probe, poses, height=HEIGHT, width=WIDTH, outputs=("labels",)))
    values = np.array([0, 1, 2, 9], np.uint8)
    decided = []
    for pose, frame in zip(poses, found, strict=True):
        weight = weights(scene, probe, pose)
        of_label = np.stack([weight[scene.labels.numpy() == value].sum(axis=0) for value in values])  # [4, H·W]
        # The skip rule leaves out less than 1/255 of each Gaussian.
        least = np.stack(
            [np.where(weight >= 1 / 255, weight, 0)[scene.labels.numpy() == value].sum(axis=0) for value in values]
        )
        order = np.argsort(of_label, axis=0)
        best, second = order[-1], order[-2]
        pixel = np.arange(HEIGHT * WIDTH)
        nothing = (of_label < SEEN * 0.999).all(axis=0)
        clear = (least[best, pixel] > of_label[second, pixel] * 1.001) & (least[best, pixel] > SEEN * 1.001)
        expected = np.where(clear, values[best], 0)
        told = nothing | clear
        np.testing.assert_array_equal(frame.ravel()[told], expected[told])
        decided += [told.mean()]
        assert {*expected[clear]} == {0, 1, 2, 9}
        assert nothing.any()
    assert np.mean(decided) > 0.8


def test_many_gaussians_in_one_place_are_counted_where_coverage_is_full(renderer):
    """30 of label 2 weigh more than 25 of label 1, though both cover the pixel as far as float32 can tell."""
    count = 55
    scene = GaussianScene.from_splats(
        {
            "means": torch.tensor([[0.0, 0.0, 2.0]]).repeat(count, 1),
            "scales": torch.full((count, 3), -0.5),
            "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
            "transmittances": torch.full((count,), 3.0),
            "sh0": torch.zeros(count, 1, 1),
        },
        labels=torch.tensor([1] * 25 + [2] * 30, dtype=torch.uint8),
    )
    frames = renderer(scene, PROBES["linear"], np.eye(4), height=11, width=11, outputs=("labels", "coverage"))
    assert frames.coverage[0, 4, 5] == 1.0
    assert label_frames(frames)[0, 4, 5] == 2


def test_of_equal_labels_the_smallest_is_taken(renderer, random_scene):
    once = random_scene(60)
    twice = {name: torch.cat([tensor, tensor]) for name, tensor in once.splats.items()}
    labels = torch.tensor([7] * 60 + [3] * 60, dtype=torch.uint8)
    scene = GaussianScene.from_splats(twice, labels=labels)
    found = label_frames(renderer(scene, PROBES["linear"], np.eye(4), height=20, width=30, outputs=("labels",)))
    assert {*np.unique(found)} == {0, 3}


def test_other_outputs_do_not_change_and_none_is_made_in_vain(renderer, labelled):
    scene, view = labelled(), (PROBES["linear"], np.eye(4)[None])
    plain = GaussianScene.from_splats(scene.splats)
    both = renderer(scene, *view, height=20, width=30, outputs=("labels", "bmode"))
    alone = renderer(plain, *view, height=20, width=30, outputs=("bmode",))
    assert alone.bmode is not None
    assert torch.equal(both.bmode, alone.bmode)
    assert both.coverage is None
    assert alone.labels is None
    assert renderer(scene, *view, height=20, width=30).labels is None  # by default: what every scene has


def test_no_poses_and_no_gaussians_give_nothing(renderer, labelled):
    scene = labelled()
    none = renderer(scene, PROBES["linear"], np.zeros((0, 4, 4)), height=9, width=7, outputs=("labels",))
    assert label_frames(none).shape == (0, 9, 7)
    nothing = replace(scene, labels=scene.labels[:0], **{name: one[:0] for name, one in scene.splats.items()})
    empty = renderer(nothing, PROBES["linear"], np.eye(4), height=9, width=7, outputs=("labels",))
    np.testing.assert_array_equal(label_frames(empty), np.zeros((1, 9, 7)))


def test_changed_labels_and_parameters_are_noticed(renderer, labelled):
    scene = labelled()
    size = {"height": 20, "width": 30, "outputs": ("labels",)}
    before = label_frames(renderer(scene, PROBES["linear"], np.eye(4), **size))
    scene.labels[scene.labels == 9] = 4
    after = label_frames(renderer(scene, PROBES["linear"], np.eye(4), **size))
    np.testing.assert_array_equal(after, np.where(before == 9, 4, before))
    scene.means.add_(torch.tensor([50.0, 0.0, 0.0]))
    assert not label_frames(renderer(scene, PROBES["linear"], np.eye(4), **size)).any()


def test_a_scene_without_labels_refuses_them(random_scene):
    with pytest.raises(UnknownOutput, match="labels only for a scene whose Gaussians carry labels") as caught:
        render(random_scene(5), PROBES["linear"], np.eye(4), height=4, width=4, outputs=("bmode", "labels"))
    assert caught.value.field == "outputs"


@pytest.mark.parametrize(
    ("labels", "names", "match"),
    [
        (torch.zeros(4, dtype=torch.int64), {1: "bone"}, r"uint8 tensor \[5\], got torch.int64 \[4\]"),
        (torch.zeros(5, dtype=torch.float32), {1: "bone"}, "got torch.float32"),
        (np.zeros(5, np.uint8), {1: "bone"}, "got ndarray"),
        (torch.zeros(5, dtype=torch.uint8), {}, "must hold one above 0"),
        (None, {1: "bone"}, "labels must be given where info.label_names names some: bone"),
    ],
)
def test_labels_that_do_not_fit_are_refused(random_scene, labels, names, match):
    with pytest.raises(InvalidArgument, match=match) as caught:
        GaussianScene.from_splats(random_scene(5).splats, info=SceneInfo(label_names=names), labels=labels)
    assert caught.value.field == "labels"


@pytest.mark.parametrize("names", [{0: "nothing"}, {256: "bone"}, {1: ""}, {1: 2}, {"bone": 1}, ["bone"], None])
def test_names_that_are_none_are_refused(names):
    with pytest.raises(InvalidArgument, match="label_names must give labels from 1 to 255 a name each"):
        SceneInfo(label_names=names)


def test_files_keep_labels_and_a_scene_without_is_written_as_before(labelled, tmp_path):
    scene = labelled(sh_degree=2)
    assert scene.labels is not None
    scene.save(tmp_path / "a.ugr")
    write_ply(scene, tmp_path / "a.ply")
    assert read_header(tmp_path / "a.ugr").info.label_names == NAMES
    for read in (GaussianScene.load(tmp_path / "a.ugr"), read_ply(tmp_path / "a.ply"), scene.to(torch.float64)):
        assert torch.equal(read.labels, scene.labels)
        assert read.info.label_names == NAMES
    assert read_ply(tmp_path / "a.ply").to_bytes() == scene.to_bytes()
    plain = GaussianScene.from_splats(scene.splats)
    assert b"label" not in plain.to_bytes()
    write_ply(plain, tmp_path / "plain.ply")
    assert b"label" not in (tmp_path / "plain.ply").read_bytes()


def test_a_file_whose_labels_are_gone_is_refused(labelled, tmp_path):
    scene = labelled()
    scene.labels = None
    scene.save(tmp_path / "a.ugr")
    with pytest.raises(SceneFileInvalid, match="labels"):
        GaussianScene.load(tmp_path / "a.ugr")


def test_the_released_format_drops_labels_and_says_so(labelled, tmp_path):
    export = export_checkpoint(labelled(), tmp_path / "out" / "ckpt.pt")
    assert "its labels are left out: the released format has none" in export.notes

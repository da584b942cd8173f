import json

import numpy as np
import pytest

from ultragray.errors import InvalidArgument
from ultragray.geometry.probe import ConvexProbe
from ultragray.rendering.display import Display
from ultragray.rendering.settings import Below
from ultragray.samplers import AroundSampler, FanSampler, SplineSampler, TrainingSampler
from ultragray_workers.jobs.kinds import RenderJob, TrainJob
from ultragray_workers.jobs.kinds.base import from_dict, in_short, to_dict

POSES = np.tile(np.eye(4), (3, 1, 1)).tolist()


@pytest.mark.parametrize(
    "job",
    [
        TrainJob("liver", "liver-1", preset="paper", settings={"steps": 10, "start": "random"}, device="cuda:1"),
        RenderJob(scene="liver", poses=POSES, height=20, width=30, outputs=("echo", "bmode"), format="tar"),
        RenderJob(scene="liver", sampler=AroundSampler(4, 2.0, 5.0, 7), format="zarr", dtype="uint8"),
        RenderJob(scene="liver", sampler=AroundSampler(4), min_confidence=1),
        RenderJob(scene="liver", poses=POSES, sampler=FanSampler(10.0, 2.5), format="dicom"),
        RenderJob(scene="liver", sampler=SplineSampler(spacing_mm=0.5)),
        RenderJob(scene="liver", sampler=TrainingSampler()),
        RenderJob(
            scene="liver",
            sampler=TrainingSampler(),
            probe=ConvexProbe(60.0, 50.0, 200.0),
            display=Display(gain_db=3.0, tgc_db=(0.0, 6.0), depth_mm=80.0, pixel_mm=0.5),
            min_confidence=0.5,
            below_min_confidence=Below.MASK,
        ),
    ],
)
def test_there_and_back(job):
    assert from_dict(json.loads(json.dumps(to_dict(job)))) == job


def test_poses_as_lists_and_packed_are_the_same_and_exact():
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = np.random.default_rng(0).normal(size=(2, 3))
    listed, packed = (
        RenderJob(scene="liver", poses=poses.tolist()),
        from_dict(to_dict(RenderJob(scene="liver", poses=poses))),
    )
    assert isinstance(packed, RenderJob)
    np.testing.assert_array_equal(packed.poses, poses)
    assert packed == listed
    poses[1, 0, 3] += 1e-12
    assert RenderJob(scene="liver", poses=poses) != listed


def test_long_names_are_cut():
    with pytest.raises(InvalidArgument) as caught:
        from_dict({"kind": "train", "dataset": "liver", "scene": "one", "x" * 10**6: 1})
    assert caught.value.field == "x" * 100
    assert len(caught.value.detail) < 300


def test_in_short_holds_no_poses():
    short = in_short(RenderJob(scene="liver", poses=POSES))
    assert short["pose_count"] == 3
    assert "poses" not in short


def train(**values):
    return {"kind": "train", "dataset": "liver", "scene": "one", **values}


def render(**values):
    return {"kind": "render", "scene": "one", "poses": POSES, **values}


def around(**values):
    return render(poses=None, sampler={"kind": "around", "count": 3, **values})


@pytest.mark.parametrize(
    ("document", "field"),
    [
        ({}, "kind"),
        ({"kind": "dance"}, "kind"),
        ({"kind": ["train"]}, "kind"),
        ({"kind": "train", "scene": "one"}, "dataset"),
        (train(scene="../one"), "scene"),
        (train(scene=5), "scene"),
        (train(preset="slow"), "preset"),
        (train(settings=[1]), "settings"),
        (train(settings={"steps": [1]}), "settings.steps"),
        (train(settings={"means_rate": float("nan")}), "settings.means_rate"),
        (train(settings={"stepz": 3}), "settings.stepz"),
        (train(settings={"steps": 0}), "settings.steps"),
        (train(settings={"steps": "many"}), "settings.steps"),
        (train(settings={"start": "x" * 101}), "settings.start"),
        (train(settings={"x" * 101: 1}), "settings"),
        (train(settings={f"a{number}": 1 for number in range(101)}), "settings"),
        (train(settings={"max_gaussians": 5, "initial_gaussians": 6}), "settings.initial_gaussians"),
        (train(preset=["fast"]), "preset"),
        (train(device="tpu"), "device"),
        (train(poses=POSES), "poses"),
        (render(poses=None), "poses"),
        (render(sampler={"kind": "training"}), "poses"),
        (render(poses=[]), "poses"),
        (render(poses="AAAA"), "poses"),
        (render(poses="no base64"), "poses"),
        (render(poses=np.full((1, 4, 4), np.nan).tolist()), "poses[0]"),
        (render(height=0), "height"),
        (render(width=True), "width"),
        (render(outputs=["colour"]), "outputs"),
        (render(probe={"kind": "round"}), "probe.kind"),
        (render(probe={"kind": "linear", "width_mm": 0, "near_mm": 0, "far_mm": 1}), "probe.width_mm"),
        (render(display={"gain_db": "loud"}), "display.gain_db"),
        (render(display={"brightness": 1}), "display.brightness"),
        (render(below_min_confidence="hide"), "below_min_confidence"),
        (render(outputs=[[1]]), "outputs[0]"),
        (render(format="zip"), "format"),
        (render(dtype="int8"), "dtype"),
        (render(min_confidence=1.5), "min_confidence"),
        (render(min_confidence=float("nan")), "min_confidence"),
        (render(min_confidence="0.5"), "min_confidence"),
        (render(min_confidence=True), "min_confidence"),
        (render(format="dicom", dtype="float32"), "dtype"),
        (render(format="plus", outputs=["bmode", "echo"]), "outputs"),
        (render(poses=None, sampler=3), "sampler"),
        (render(poses=None, sampler={}), "sampler.kind"),
        (render(poses=None, sampler={"kind": "training", "count": 3}), "sampler.count"),
        (around(count=0), "sampler.count"),
        (around(translation_mm=-1), "sampler.translation_mm"),
        (around(translation_mm=10**400), "sampler.translation_mm"),
        (around(rotation_deg="much"), "sampler.rotation_deg"),
        (around(seed=0.5), "sampler.seed"),
        (around(kind="jitter"), "sampler.kind"),
        (around(speed=1), "sampler.speed"),
    ],
)
def test_refused_with_the_field(document, field):
    with pytest.raises(InvalidArgument) as caught:
        from_dict(document)
    assert caught.value.field == field

"""Trainings that begin with a scene made from labels: few frames mend it where they look."""

import numpy as np
import pytest

from ultragray import LinearProbe, render
from ultragray.datasets import Sweep
from ultragray.errors import InvalidArgument
from ultragray.learn.sweep import Dataset
from ultragray.learn.synthesis.scene import scene_from_labels
from ultragray.learn.training import TrainingConfig, train
from ultragray.scene.recipes import SceneRecipe, TissueBody
from ultragray.scene.shapes import BoxShape, TubeShape

PROBE = LinearProbe(width_mm=24.0, near_mm=0.0, far_mm=24.0)
BLOCK = BoxShape(min_mm=(-14.0, -12.0, 0.0), max_mm=(14.0, 12.0, 26.0))
TUBE = TubeShape(points_mm=((0.0, -12.0, 12.0), (0.0, 12.0, 12.0)), radius_mm=4.0)
CONFIG = TrainingConfig(steps=60, confidence=False, refine_poses="none", batch_size=4)


def recipe(echo_db: float) -> SceneRecipe:
    bodies = TissueBody(tissue="liver", shape=BLOCK), TissueBody(tissue="tumour", shape=TUBE, echo_db=echo_db)
    view = {"towards": (0.0, 0.0, 1.0), "along": (0.0, 1.0, 0.0), "probe": PROBE, "sweep_mm": 16.0, "pose_count": 17}
    return SceneRecipe(bodies=bodies, **view, gaussian_count=3_000, image_size=48)


@pytest.fixture(scope="module")
def frames():
    """Frames of a patient whose tumour is brighter than the table has it: six to one side, and one held out there."""
    truth = scene_from_labels(recipe(9.0))
    poses = truth.training_poses[1:8]
    images = render(truth, None, poses, height=48, width=48, outputs=("bmode",))["bmode"]
    sweep = Sweep((255.0 * images.numpy()).astype(np.uint8), poses, PROBE, np.arange(7), "patient")
    kept = np.array([0, 1, 2, 4, 5, 6])
    return Dataset("patient", train=sweep.select(kept), val=sweep.select(np.array([3])))


def psnr(scene, sweep: Sweep) -> float:
    found = render(scene, PROBE, sweep.poses, height=48, width=48, outputs=("bmode",))["bmode"].numpy()
    return float(-10.0 * np.log10(np.square(found - sweep.images / 255.0).mean()))


def test_a_few_frames_mend_a_made_scene_which_keeps_its_labels_where_they_do_not_look(frames):
    start = scene_from_labels(recipe(-9.0))
    refined = train(frames, CONFIG, start=start)
    assert refined.gaussian_count == start.gaussian_count
    assert psnr(refined, frames.val) > psnr(start, frames.val) + 3.0
    names = refined.info.label_names
    assert set(names.values()) == {"liver", "tumour", "liver (not recorded)", "tumour (not recorded)"}
    made = {names[label] for label in refined.info.made_labels}
    assert made == {"liver (not recorded)", "tumour (not recorded)"}
    places = np.asarray(refined.info.centre_mm) + 10.0 * refined.means.numpy()
    recorded = ~np.isin(refined.labels.numpy(), refined.info.made_labels)
    assert recorded[(places[:, 1] > -7.0) & (places[:, 1] < -2.0)].mean() > 0.85
    assert not recorded[places[:, 1] > 2.0].any()
    assert list(refined.info.provenance["parents"]) == ["start"]


def test_a_training_of_other_intensities_begins_with_no_scene(frames):
    config = TrainingConfig(steps=2, intensity="released", confidence=False)
    with pytest.raises(InvalidArgument, match="sigmoid"):
        train(frames, config, start=scene_from_labels(recipe(-9.0)))

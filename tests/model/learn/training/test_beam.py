"""Training with a beam: a given one makes slices thin again, and one that nobody gave is found."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import ElevationBeam, GaussianScene, LinearProbe, SceneInfo, render
from ultragray.errors import InvalidArgument
from ultragray.learn.sweep import Dataset, Sweep
from ultragray.learn.training import TrainingConfig, train
from ultragray.learn.training.beam import TrainedBeam

PROBE = LinearProbe(width_mm=20.0, near_mm=1.0, far_mm=25.0)
SIDE, POINTS = 48, 60
FOCUSED = ElevationBeam(thickness_mm=2.0, focus_mm=12.0, depth_of_field_mm=10.0)
CONSTANT = ElevationBeam(thickness_mm=3.0)
LEARNING = TrainingConfig(steps=500, confidence=False, learn_beam=True)


def phantom():
    """Points and speckle: Gaussians much smaller than the beams."""
    rng = np.random.default_rng(1)
    count = POINTS + 3000
    brightness = np.concatenate([np.full(POINTS, 0.95), rng.beta(1.2, 4.0, count - POINTS)])
    splats = {
        "means": (rng.random((count, 3)) - 0.5) * (2.2, 2.2, 2.4) + (0.0, 0.0, 1.3),
        "scales": rng.uniform(np.log(0.015), np.log(0.035), (count, 3)),
        "quats": rng.normal(size=(count, 4)),
        "transmittances": np.full(count, 9.0),
        "sh0": (np.log(brightness / (1.0 - brightness)) / (4.0 * 0.28209479)).reshape(-1, 1, 1),
    }
    tensors = {name: torch.tensor(values, dtype=torch.float32) for name, values in splats.items()}
    return GaussianScene.from_splats(tensors, info=SceneInfo(intensity="sigmoid"))


def turned(axis, angle_deg):  # [4, 4]: about an axis through the middle of the image
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    turn, i, j = np.eye(4), (axis + 1) % 3, (axis + 2) % 3
    turn[[i, j], [i, j]], turn[i, j], turn[j, i] = cosine, -sine, sine
    there, back = np.eye(4), np.eye(4)
    there[2, 3], back[2, 3] = 13.0, -13.0
    return there @ turn @ back


def sweep_poses(turn, count=20, spacing_mm=0.9):  # [count, 4, 4]
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 1, 3] = (np.arange(count) - (count - 1) / 2) * spacing_mm
    return turn @ poses


SWEEPS = {
    "crossing": np.concatenate([sweep_poses(turned(2, 0.0)), sweep_poses(turned(2, 90.0))]),
    "tilted": np.concatenate([sweep_poses(turned(0, -20.0)), sweep_poses(turned(0, 20.0))]),
}


def frames(scene, poses, beam):  # [C, H, W]
    return render(scene, PROBE, poses, height=SIDE, width=SIDE, outputs=("bmode",), beam=beam)["bmode"].numpy()


def imaged(scene, poses, beam):
    images = np.round(255.0 * frames(scene, poses, beam)).astype(np.uint8)
    whole = Sweep(images=images, poses=poses, probe=PROBE, frame_numbers=np.arange(len(poses)), source="phantom")
    return Dataset("phantom", whole, whole.select([]))


@pytest.mark.long
@pytest.mark.parametrize(
    ("sweeps", "beam"), [("crossing", FOCUSED), ("crossing", CONSTANT), ("tilted", FOCUSED), ("tilted", CONSTANT)]
)
def test_a_beam_that_nobody_gave_is_found(sweeps, beam):
    found = train(imaged(phantom(), SWEEPS[sweeps], beam), LEARNING).info.beam
    for depth_mm in (4.0, 8.0, 12.0, 16.0, 20.0):
        assert found.thickness_at_mm(depth_mm) == pytest.approx(beam.thickness_at_mm(depth_mm), rel=0.15)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("start_mm", [0.5, 8.0])
def test_wherever_the_search_starts(start_mm):
    config = replace(LEARNING, slice_thickness_mm=start_mm)
    found = train(imaged(phantom(), SWEEPS["crossing"], FOCUSED), config).info.beam
    assert found.thickness_at_mm(12.0) == pytest.approx(2.0, rel=0.15)


def test_a_resumed_run_ends_in_the_same_beam(tmp_path):
    dataset = imaged(phantom(), SWEEPS["crossing"][::4], FOCUSED)
    config = TrainingConfig(steps=12, max_gaussians=400, confidence=False, learn_beam=True, slice_thickness_mm=3.0)
    whole = train(dataset, config)
    steps_done = iter(range(6))
    train(dataset, config, folder=tmp_path / "run", should_stop=lambda: next(steps_done) == 5)
    resumed = train(dataset, config, folder=tmp_path / "run", resume=True)
    assert resumed.info.beam == whole.info.beam != CONSTANT


def test_without_a_beam_a_scene_has_none_and_keeps_its_file():
    dataset = imaged(phantom(), SWEEPS["crossing"][::4], CONSTANT)
    scene = train(dataset, TrainingConfig(steps=2, max_gaussians=50, confidence=False))
    assert scene.info.beam is None
    assert TrainedBeam(TrainingConfig(), PROBE).numbers is None


def test_a_beam_thinner_than_the_gaps_is_doubtful():
    thin, given = (
        TrainedBeam(TrainingConfig(slice_thickness_mm=0.4, learn_beam=learned), PROBE) for learned in (True, False)
    )
    assert thin.is_doubtful(frame_spacing_mm=1.0)
    assert not thin.is_doubtful(frame_spacing_mm=0.5)
    assert not given.is_doubtful(frame_spacing_mm=1.0)


@pytest.mark.parametrize(
    "shape", [{"slice_focus_mm": 9.0}, {"slice_thickness_mm": 2.0, "slice_depth_of_field_mm": 9.0}]
)
def test_half_a_beam_is_refused(shape):
    with pytest.raises(InvalidArgument, match="must be given together"):
        TrainingConfig(**shape)

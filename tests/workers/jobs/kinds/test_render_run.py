"""The work of render jobs, in this process."""

import json
import sys

import cv2
import numpy as np
import pydicom
import pytest

from ultragray import ConvexProbe, ElevationBeam, GaussianScene, LinearProbe, render
from ultragray.contract import to_dict as to_json
from ultragray.errors import ExtraMissing, FrameTooCostly, InvalidArgument, InvalidProbe, LowConfidence
from ultragray.exchange import rendering
from ultragray.files import file_sha256
from ultragray.rendering.display import Display
from ultragray.rendering.frames import show
from ultragray.rendering.settings import Below
from ultragray.rendering.tools import Cylinder, Needle, ToolFrame
from ultragray.samplers import AroundSampler, CoveredSampler, FanSampler, SplineSampler, TrainingSampler
from ultragray.scene.confidence import Assessor, ConfidenceModel, Support, figure_arrays
from ultragray_workers.jobs.folder import JobFolder
from ultragray_workers.jobs.kinds import RenderJob, render_run
from ultragray_workers.jobs.kinds.base import from_dict, to_dict
from ultragray_workers.jobs.worker.job_run import JobRun, Stopped

from ..conftest import request_of

PROBE = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)
TRAINING = np.tile(np.eye(4), (6, 1, 1))
TRAINING[:, 1, 3] = np.arange(6)
MODEL = ConfidenceModel((3.5, 1.2, 0.8, 0.1, 0.6), 0.06, (0.0,) * 6, 20, 0.04).to_dict()
# A frame must have 2.3% of support for a confidence of 0.6: one in four about the training poses does.
OF_SUPPORT = ConfidenceModel(
    (3.5, 1.2, 0.8, 0.1, 0.6), 0.06, (0.0,) * 6, 20, 0.04, Support(25.0, share=0.04, reach_mm=20.0)
).to_dict()


@pytest.fixture
def work(tmp_path, random_scene):
    """The work of a job whose folder holds its scene."""
    info = {"probe": PROBE, "image_height": 24, "image_width": 20}

    def make(job, *, should_stop=lambda: False, max_footprint_pixels=None, **changes):
        folder = JobFolder(tmp_path, "job")
        folder.path.mkdir(parents=True)
        made = random_scene(60, info=info | changes)
        scene = GaussianScene.from_splats(made.splats, info=made.info, training_poses=TRAINING)
        scene.save(folder.path / f"{job.scene}.ugr")
        return JobRun(
            folder, request_of(to_dict(job), tmp_path, max_footprint_pixels=max_footprint_pixels), should_stop
        )

    return make


def test_poses_of_the_sampler_are_rendered_and_in_the_archive(work):
    job = RenderJob(scene="one", sampler=CoveredSampler(50, seed=2), outputs=("bmode", "coverage"), dtype="uint8")
    asked = work(job)
    outcome = render_run.run(asked, job)
    examples = [f"example_{place:05d}.png" for place in (0, 10, 20, 29, 39, 49)]
    assert outcome.artifacts == (*examples, "frames.npz")
    assert outcome.metrics == {}  # the scene knows no confidence
    assert outcome.sha256 == {"frames.npz": file_sha256(asked.folder.artifacts / "frames.npz")}
    drawn = cv2.imread(str(asked.folder.artifacts / examples[0]), cv2.IMREAD_UNCHANGED)
    assert (drawn.dtype, max(drawn.shape)) == (np.uint8, render_run.EXAMPLE_SIDE)
    assert (asked.progress.frames_done, asked.progress.frames) == (50, 50)
    scene = GaussianScene.load(asked.folder.path / "one.ugr")
    with np.load(asked.folder.artifacts / "frames.npz") as archive:
        np.testing.assert_array_equal(archive["poses"], CoveredSampler(50, seed=2).poses(TRAINING, PROBE))
        frames = render(scene, None, archive["poses"], height=24, width=20)
        for name in job.outputs:
            assert archive[name].dtype == np.uint8
            np.testing.assert_array_equal(archive[name], np.rint(getattr(frames, name).numpy() * 255))


def test_tools_are_in_the_frames_with_their_labels(work):
    tools = (
        Needle(tip_mm=(5.0, 0.0, 25.0), hub_mm=(-12.0, 0.0, 8.0), frame=ToolFrame.PROBE, label=7),
        Cylinder(tip_mm=(8.0, -9.0, 30.0), hub_mm=(8.0, 9.0, 30.0), diameter_mm=4.0),
    )
    job = RenderJob(scene="one", sampler=TrainingSampler(), outputs=("bmode", "labels"), tools=tools, ghost=0.5)
    asked = work(job)
    assert from_dict(to_dict(job)) == job
    assert "frames.npz" in render_run.run(asked, job).artifacts
    scene = GaussianScene.load(asked.folder.path / "one.ugr")
    with np.load(asked.folder.artifacts / "frames.npz") as archive:
        frames = render(scene, None, archive["poses"], height=24, width=20, outputs=job.outputs, tools=tools, ghost=0.5)
        np.testing.assert_allclose(archive["bmode"], frames["bmode"].numpy(), atol=1e-6)
        np.testing.assert_array_equal(archive["labels"], frames["labels"].numpy())
        assert {7, 255} <= set(np.unique(archive["labels"]).tolist())
        assert json.loads(str(archive["tools"])) == to_json(tools)
        assert float(archive["ghost"]) == 0.5


def test_dicom_of_given_poses_in_a_fan(work):
    job = RenderJob(
        scene="one", poses=TRAINING[:2].tolist(), sampler=FanSampler(5, 5), format="dicom", height=16, width=12
    )
    asked = work(job)
    assert render_run.run(asked, job).artifacts[-1] == "frames.dcm"
    data = pydicom.dcmread(asked.folder.artifacts / "frames.dcm")
    assert data.pixel_array.shape == (6, 16, 12)
    poses = np.frombuffer(data.private_block(0x0019, "ULTRAGRAY")[0x01].value, "<f8").reshape(-1, 4, 4)
    np.testing.assert_array_equal(poses, FanSampler(5, 5).poses(TRAINING[:2], PROBE))


def test_figures_of_each_frame_are_in_the_archive(work, monkeypatch):
    job = RenderJob(scene="one", sampler=AroundSampler(40, translation_mm=8.0), min_confidence=0.6, outputs=("echo",))
    asked = work(job, confidence=OF_SUPPORT)
    monkeypatch.setattr(rendering, "frames_at_once", lambda height, width: 7)
    monkeypatch.setattr(render_run, "ASSESSED_AT_ONCE", 60)
    metrics = render_run.run(asked, job).metrics
    scene = GaussianScene.load(asked.folder.path / "one.ugr")
    with np.load(asked.folder.artifacts / "frames.npz") as archive:
        assert metrics["least_confidence"] == pytest.approx(archive["confidence"].min())
        assert metrics["greatest_confidence"] == pytest.approx(archive["confidence"].max())
        poses = archive["poses"]
        coverage = render(scene, None, poses, height=24, width=20, outputs=("coverage",)).coverage
        told = Assessor(scene.info, TRAINING).assess(poses, coverage=coverage.numpy())
        for name, figures in figure_arrays(told).items():
            np.testing.assert_allclose(archive[name], figures, rtol=1e-6)
        assert len(poses) == 40
        assert archive["confidence"].min() >= 0.6
        assert np.ptp(archive["supported_share"]) > 0
        assert "coverage" not in archive


def test_a_pose_below_the_limit_ends_the_job_before_it_renders(work):
    far = TRAINING.copy()
    far[4, 1, 3] = 40.0
    job = RenderJob(scene="one", poses=far, min_confidence=0.5)
    asked = work(job, confidence=MODEL)
    with pytest.raises(LowConfidence, match=r"poses\[4\] has"):
        render_run.run(asked, job)
    assert not asked.folder.artifacts.exists()


def test_a_long_search_stops_with_its_job(work, monkeypatch):
    stops = iter([False, False, True])
    monkeypatch.setattr(render_run, "ASSESSED_AT_ONCE", 60)
    job = RenderJob(scene="one", sampler=AroundSampler(1000), min_confidence=0.99)
    with pytest.raises(Stopped):
        render_run.run(work(job, should_stop=lambda: next(stops), confidence=MODEL), job)


def test_nothing_is_left_of_a_job_that_stops(work):
    stops = iter([False, True])
    job = RenderJob(scene="one", sampler=SplineSampler(count=100), height=256, width=256)
    asked = work(job, should_stop=lambda: next(stops))
    with pytest.raises(Stopped):
        render_run.run(asked, job)
    assert [path.name for path in asked.folder.path.iterdir() if path.name != "progress.json"] == ["one.ugr"]


def test_a_sampler_that_cannot_use_the_poses(work):
    job = RenderJob(scene="one", poses=TRAINING[:1].tolist(), sampler=SplineSampler(count=5))
    with pytest.raises(InvalidArgument, match="two different base poses"):
        render_run.run(work(job), job)


def test_a_scene_without_a_probe(work):
    job = RenderJob(scene="one", sampler=TrainingSampler())
    with pytest.raises(InvalidProbe):
        render_run.run(work(job, probe=None), job)


def test_a_missing_package_is_told_before_anything_is_rendered(work, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    monkeypatch.delitem(sys.modules, "ultragray.exchange.exports.hdf5", raising=False)
    job = RenderJob(scene="one", sampler=TrainingSampler(), format="hdf5")
    with pytest.raises(ExtraMissing, match=r"pip install 'ultragray\[hdf5\]'"):
        render_run.run(work(job), job)


def test_frames_are_shown_as_asked_and_the_archive_says_where_their_pixels_lie(work):
    probe, display = ConvexProbe(50.0, 20.0, 60.0), Display(gain_db=2.0, depth_mm=30.0, pixel_mm=0.8, flip=True)
    job = RenderJob(scene="one", sampler=TrainingSampler(), probe=probe, display=display)
    asked = work(job)
    render_run.run(asked, job)
    picture = display.picture(probe, 24, 20)
    with np.load(asked.folder.artifacts / "frames.npz") as archive:
        origin = {name: json.loads(str(archive[name])) for name in ("probe", "display", "picture")}
        assert archive["bmode"].shape == (len(TRAINING), picture.height, picture.width)
        assert origin["probe"] == to_json(probe)
        assert origin["display"]["pixel_mm"] == 0.8
        assert origin["picture"]["first"] == list(picture.first)
        scene = GaussianScene.load(asked.folder.path / "one.ugr")
        rendered = {"bmode": render(scene, probe, TRAINING, height=24, width=20)["bmode"]}
        np.testing.assert_allclose(archive["bmode"], show(rendered, probe, display)["bmode"].numpy(), atol=1e-6)


def test_frames_are_as_thick_as_asked_and_the_archive_says_so(work):
    job = RenderJob(scene="one", sampler=TrainingSampler(), slice_thickness_mm=5.0)
    asked = work(job)
    render_run.run(asked, job)
    scene = GaussianScene.load(asked.folder.path / "one.ugr")
    expected = render(scene, None, TRAINING, height=24, width=20, beam=ElevationBeam(5.0))["bmode"]
    with np.load(asked.folder.artifacts / "frames.npz") as archive:
        np.testing.assert_allclose(archive["bmode"], expected.numpy(), atol=1e-6)
        assert float(archive["slice_thickness_mm"]) == 5.0


def test_frames_below_the_limit_are_masked_instead_of_refused(work):
    far = TRAINING.copy()
    far[4, 1, 3] = 40.0
    job = RenderJob(
        scene="one", poses=far, min_confidence=0.6, below_min_confidence=Below.MASK, outputs=("bmode", "coverage")
    )
    asked = work(job, confidence=MODEL)
    render_run.run(asked, job)
    with np.load(asked.folder.artifacts / "frames.npz") as archive:
        assert archive["bmode"].shape[0] == len(far)
        assert (archive["bmode"][4] > 0).sum() < (archive["bmode"][0] > 0).sum()


def test_a_frame_that_costs_more_than_the_limit_fails_the_job_and_is_named(work):
    job = RenderJob(scene="one", poses=TRAINING[:2].tolist(), height=16, width=12)
    asked = work(job, max_footprint_pixels=1)
    with pytest.raises(FrameTooCostly, match="ask for fewer pixels") as refused:
        render_run.run(asked, job)
    assert refused.value.field == "poses[0]"
    assert not list(asked.folder.artifacts.glob("*"))

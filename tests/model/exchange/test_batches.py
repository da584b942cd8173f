"""Plans of batches, and the files of their shards."""

import hashlib
import io
import json
import pickle
import tarfile

import numpy as np
import pytest
import torch

from ultragray import GaussianScene, LinearProbe, render
from ultragray.errors import FrameTooCostly, InvalidArgument
from ultragray.exchange.batches import SHARD_FRAMES, BatchPlan, ShardEntry, manifest, names_in, stands_for
from ultragray.exchange.shards import ShardRenderer, ShardTar
from ultragray.files import file_sha256
from ultragray.rendering.limits import Limits
from ultragray.rendering.settings import FrameSettings
from ultragray.samplers import AroundSampler, FanSampler, SplineSampler
from ultragray.scene.confidence import Assessor, Extrapolation
from ultragray.scene.info import read_header

PROBE = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)
TRAINING = np.tile(np.eye(4), (6, 1, 1))
TRAINING[:, 1, 3] = np.arange(6)
CPU = torch.device("cpu")


@pytest.fixture
def scene_file(tmp_path, random_scene):
    made = random_scene(60, info={"probe": PROBE, "image_height": 24, "image_width": 20})
    path = tmp_path / "one.ugr"
    GaussianScene.from_splats(made.splats, info=made.info, training_poses=TRAINING).save(path)
    return path


def plan_of(scene_file, **changes):
    values = {
        "sampler": AroundSampler(110, seed=3),
        "poses": None,
        "shard_frames": 40,
        "scene": "one",
        "scene_sha256": file_sha256(scene_file),
    }
    settings = changes.pop("settings", FrameSettings())
    return BatchPlan.prepared(read_header(scene_file), settings, **values | changes)


def members(path):
    with tarfile.open(path) as tar:
        for member in tar:
            file = tar.extractfile(member)
            yield member.name, file.read()


def frames_of(path):
    return {name[:-10]: np.load(io.BytesIO(data)) for name, data in members(path) if name.endswith(".bmode.npy")}


def test_a_plan_divides_its_frames():
    names = {"scene": "one", "scene_sha256": "0", "settings": FrameSettings(), "sampler": None, "poses": None}
    plan = BatchPlan(**names, frames=10_000_001, shard_frames=5_000)
    assert plan.shard_count == 2001
    assert (plan.frames_of(0), plan.frames_of(2000)) == (range(5000), range(10_000_000, 10_000_001))
    assert plan.file_name(17) == "frames-000017.tar"
    assert plan.file_names == "frames-{000000..002000}.tar"
    assert (plan.key(0), plan.key(10_000_000)) == ("00000000", "10000000")
    assert list(names_in("frames-{000009..000011}.tar")) == [f"frames-{number:06d}.tar" for number in (9, 10, 11)]
    assert stands_for(plan.file_names, "frames-002000.tar")
    for other in ("frames-002001.tar", "frames-17.tar", "frames-000017.tar.tar", "frames--00001.tar", "x-000017.tar"):
        assert not stands_for(plan.file_names, other)
    assert BatchPlan(**names, frames=3, shard_frames=5).file_names == "frames-000000.tar"


def test_frames_are_those_of_one_rendering_however_they_are_divided(scene_file, tmp_path):
    scene = GaussianScene.load(scene_file)
    poses = AroundSampler(110, seed=3).poses(TRAINING, PROBE)
    whole = np.rint(render(scene, None, poses, height=24, width=20, outputs=("bmode",))["bmode"].numpy() * 255)
    for shard_frames in (40, 7):
        plan = pickle.loads(pickle.dumps(plan_of(scene_file, shard_frames=shard_frames)))
        renderer = ShardRenderer(plan, scene_file, CPU)
        found = {}
        for shard in reversed(range(plan.shard_count)):
            entry = renderer.render(shard, tmp_path / "shard.tar")
            assert (entry.file, entry.frames) == (plan.file_name(shard), len(plan.frames_of(shard)))
            data = (tmp_path / "shard.tar").read_bytes()
            assert (entry.bytes, entry.sha256) == (len(data), hashlib.sha256(data).hexdigest())
            found |= frames_of(tmp_path / "shard.tar")
        assert sorted(found) == [f"{number:06d}" for number in range(110)]
        np.testing.assert_array_equal([found[key] for key in sorted(found)], whole)


def test_a_shard_is_the_same_bytes_each_time_and_tells_pose_and_figures(scene_file, tmp_path):
    plan = plan_of(scene_file, settings=FrameSettings(outputs=("bmode", "coverage")), dtype="float32")
    first = ShardRenderer(plan, scene_file, CPU).render(2, tmp_path / "first.tar")
    again = ShardRenderer(plan, scene_file, CPU).render(2, tmp_path / "again.tar")
    assert first == again
    found = dict(members(tmp_path / "first.tar"))
    assert list(found)[:3] == ["000080.bmode.npy", "000080.coverage.npy", "000080.json"]
    assert np.load(io.BytesIO(found["000080.coverage.npy"])).dtype == np.float32
    pose = AroundSampler(110, seed=3).poses(TRAINING, PROBE)[80]
    told = json.loads(found["000080.json"])
    assert told.pop("pose") == pose.tolist()
    header = read_header(scene_file)
    coverage = np.load(io.BytesIO(found["000080.coverage.npy"]))[None]
    expected = Assessor(header.info, header.training_poses).assess(pose, coverage=coverage)[0]
    assert told == {name: value if value is None else round(value, 6) for name, value in expected.figures().items()}


def test_the_tar_is_one_that_tarfile_reads_and_would_write(tmp_path):
    pixels = np.arange(2 * 3 * 5, dtype=np.uint8).reshape(2, 3, 5)
    figures = [Extrapolation(1.23456789, None, 0.5, 1.0)] * 2
    with ShardTar(tmp_path / "ours.tar") as tar:
        tar.add(["000000", "000001"], np.tile(np.eye(4), (2, 1, 1)), figures, {"bmode": pixels})
        digest = tar.finish()
    with tarfile.open(tmp_path / "theirs.tar", "w", format=tarfile.USTAR_FORMAT) as theirs:
        for name, data in members(tmp_path / "ours.tar"):
            member = tarfile.TarInfo(name)
            member.size = len(data)
            theirs.addfile(member, io.BytesIO(data))
    ours = (tmp_path / "ours.tar").read_bytes()
    assert ours == (tmp_path / "theirs.tar").read_bytes()
    assert digest == hashlib.sha256(ours).hexdigest()


def test_a_costly_frame_is_named_by_its_number_in_the_batch(scene_file, tmp_path):
    limits = Limits(1, name_pose="frame {}".format)
    with pytest.raises(FrameTooCostly) as caught:
        ShardRenderer(plan_of(scene_file), scene_file, CPU, limits=limits).render(1, tmp_path / "shard.tar")
    assert caught.value.field == "frame 40"


def test_another_scene_is_refused(scene_file):
    with pytest.raises(InvalidArgument, match="not the scene of the plan"):
        ShardRenderer(plan_of(scene_file, scene_sha256="0"), scene_file, CPU)


def test_plans_that_no_shard_could_be_made_of(scene_file):
    with pytest.raises(InvalidArgument, match="shard_frames must be at least 500"):
        plan_of(scene_file, sampler=AroundSampler(10_000_000), shard_frames=10)
    with pytest.raises(InvalidArgument, match="two different base poses"):
        plan_of(scene_file, sampler=SplineSampler(count=5), poses=TRAINING[:1])
    plan = plan_of(scene_file, sampler=AroundSampler(10_000_000), shard_frames=None)
    assert (plan.frames, plan.shard_frames, plan.shard_count) == (10_000_000, SHARD_FRAMES, 2000)


def test_the_identity_follows_from_what_is_asked_for(scene_file):
    changes = [
        {},
        {"sampler": AroundSampler(110, seed=4)},
        {"sampler": FanSampler(5.0, 5.0)},
        {"poses": TRAINING[:3]},
        {"poses": TRAINING[1:4]},
        {"shard_frames": 41},
        {"settings": FrameSettings(height=32)},
        {"dtype": "float32"},
    ]
    assert len({plan_of(scene_file, **one).identity for one in changes}) == len(changes)
    assert plan_of(scene_file).identity == plan_of(scene_file).identity


def test_a_manifest_lists_every_shard_or_is_refused(scene_file):
    plan = plan_of(scene_file)
    entries = [
        ShardEntry(
            plan.file_name(shard), plan.frames_of(shard).start, len(plan.frames_of(shard)), 10, "00", "r", plan.identity
        )
        for shard in range(plan.shard_count)
    ]
    document = json.loads(json.dumps(manifest(plan, entries)))
    assert document["plan"] == plan.identity
    assert document["sampler"] == {
        "kind": "around",
        "count": 110,
        "translation_mm": 2.0,
        "rotation_deg": 5.0,
        "seed": 3,
    }
    assert [(shard["file"], shard["first"], shard["frames"]) for shard in document["shards"]] == [
        ("frames-000000.tar", 0, 40),
        ("frames-000001.tar", 40, 40),
        ("frames-000002.tar", 80, 30),
    ]
    with pytest.raises(InvalidArgument, match=r"frames-000001\.tar is missing"):
        manifest(plan, [entries[0], entries[2]])
    with pytest.raises(InvalidArgument, match=r"frames-000000\.tar is of another batch"):
        manifest(plan_of(scene_file, dtype="float32"), entries)

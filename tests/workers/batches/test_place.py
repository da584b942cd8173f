"""The place of a batch, in a folder and in a bucket."""

import json

import pytest
import torch

from ultragray.errors import InvalidArgument
from ultragray.exchange.shards import ShardRenderer
from ultragray_workers.batches.place import ShardPlace
from ultragray_workers.storage.location import open_storage

from .conftest import plan_of


def make(place, scene_file, folder, shard):
    path = folder / f"{shard}.tar"
    place.keep(path, shard, ShardRenderer(place.plan, scene_file, torch.device("cpu")).render(shard, path))
    path.unlink()


def test_a_batch_comes_together_whatever_happens_to_its_shards(storage, plan, scene_file, tmp_path):
    place = ShardPlace(storage, "some/batch", plan)
    assert place.whole() == []
    for shard in (2, 0):
        make(place, scene_file, tmp_path, shard)
    assert place.whole() == [0, 2]
    with pytest.raises(InvalidArgument, match=r"frames-000001\.tar is missing"):
        place.finish()
    assert not place.is_finished()
    storage.write("some/batch/frames-000002.tar", b"damaged")
    assert place.whole() == [0]
    storage.delete("some/batch/frames-000000.tar")
    assert place.whole() == []
    for shard in range(3):
        make(place, scene_file, tmp_path, shard)
    assert place.entry(1) is not None
    place.finish()
    assert place.is_finished()
    assert sorted(entry.key for entry in storage.entries("some/batch")) == [
        *(f"some/batch/frames-{number:06d}.tar" for number in range(3)),
        "some/batch/manifest.json",
    ]
    manifest = json.loads(storage.read("some/batch/manifest.json"))
    assert manifest["plan"] == plan.identity
    assert sum(shard["frames"] for shard in manifest["shards"]) == 110


def test_shards_of_another_plan_do_not_count(storage, plan, scene_file, tmp_path):
    make(ShardPlace(storage, "batch", plan), scene_file, tmp_path, 0)
    other = ShardPlace(storage, "batch", plan_of(scene_file, 111, 40))
    assert other.whole() == []
    storage.write("batch/manifest.json", b"{}")
    with pytest.raises(InvalidArgument, match="of another batch: choose another place"):
        other.is_finished()


def test_a_damaged_shard_of_a_folder_is_made_again(plan, scene_file, tmp_path):
    place = ShardPlace(open_storage(tmp_path / "folder"), "", plan)
    make(place, scene_file, tmp_path, 0)
    path = tmp_path / "folder" / "frames-000000.tar"
    data = bytearray(path.read_bytes())
    data[5_000] ^= 1
    path.write_bytes(data)
    assert place.entry(0) is None

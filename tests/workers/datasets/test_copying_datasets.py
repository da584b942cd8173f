"""Copies of datasets into a storage that hosts share: whole, resumable, and never over another."""

import json

import pytest

from ultragray_workers.backup.copying import CopiedDatasets, copy_datasets
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import RestoreRefused
from ultragray_workers.storage.local import LocalStorage

from ..jobs.conftest import store_dataset


@pytest.fixture
def artifacts(tmp_path):
    for name in ("one", "two"):
        store_dataset(tmp_path / "artifacts", name)
    return tmp_path / "artifacts"


def test_datasets_are_copied_once_and_read_as_they_were(artifacts, tmp_path):
    bucket = LocalStorage(tmp_path / "bucket")
    said = []
    assert copy_datasets(LocalStorage(artifacts), bucket, said.append) == CopiedDatasets(2, 0)
    assert said == ["1 of 2: dataset one copied", "2 of 2: dataset two copied"]
    copies = DatasetStore(tmp_path / "host", bucket)
    assert copies.names() == ["one", "two"]
    assert copies.get("two") == DatasetStore(artifacts).get("two")
    assert copies.load("two").sha256 == DatasetStore(artifacts).load("two").sha256
    copies.delete("one")
    assert copy_datasets(LocalStorage(artifacts), bucket) == CopiedDatasets(1, 1)


def test_another_dataset_of_that_name_stays(artifacts, tmp_path):
    bucket = LocalStorage(tmp_path / "bucket")
    copy_datasets(LocalStorage(artifacts), bucket)
    manifest = artifacts / "datasets" / "one.json"
    manifest.write_text(json.dumps({**json.loads(manifest.read_text()), "sha256": "0" * 64}))
    with pytest.raises(RestoreRefused, match="has another dataset 'one'"):
        copy_datasets(LocalStorage(artifacts), bucket)
    assert DatasetStore(tmp_path / "host", bucket).get("one").sha256 != "0" * 64

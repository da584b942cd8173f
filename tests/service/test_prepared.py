"""Folders that helper processes make: once, whole, and the oldest go."""

from __future__ import annotations

import asyncio
import json
import os
import time
from pathlib import Path

import numpy as np
import pytest

from ultragray.datasets.released import write_released
from ultragray.errors import DatasetNotFound, MemoryExceeded
from ultragray_service import prepared
from ultragray_service.prepared import PreparedFolders
from ultragray_service.settings import Settings
from ultragray_workers.dataset_intake import check_files
from ultragray_workers.dataset_store import DatasetStore, write_manifest

from .test_http_comparison import DATASET


@pytest.fixture
def request_body(tmp_path: Path) -> dict[str, str]:
    """A dataset `tiny` in an artifact folder."""
    folder = DatasetStore(tmp_path).folder / "tiny"
    (folder / "files").mkdir(parents=True)
    write_released(DATASET, folder / "files")
    write_manifest(check_files(folder / "files", "tiny", {}, folder / "contact_sheet.png"), folder)
    return {"artifact_folder": str(tmp_path), "dataset": "tiny"}


def folders(tmp_path: Path) -> PreparedFolders:
    return PreparedFolders(tmp_path / "views", "dataset_view", "laying out", Settings(data_folder=tmp_path))


def names(tmp_path: Path) -> list[str]:
    return sorted(path.name for path in (tmp_path / "views").iterdir())


def test_who_asks_at_the_same_time_gets_the_same_folder(tmp_path: Path, request_body: dict[str, str]) -> None:
    async def ask() -> list[Path]:
        made = folders(tmp_path)
        return await asyncio.gather(*(made.path("key", request_body) for _ in range(3)))

    found = asyncio.run(ask())
    assert set(found) == {tmp_path / "views" / "key"}
    poses = json.loads((found[0] / "poses.json").read_text())
    np.testing.assert_allclose(np.reshape(poses["val"], (-1, 4, 4)), DATASET.val.poses, atol=1e-9)
    assert names(tmp_path) == ["key"]


def test_the_folder_not_asked_for_the_longest_goes(
    tmp_path: Path, request_body: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(prepared, "KEPT_FOLDERS", 2)
    for age_s, name in ((300, "old"), (200, "older-but-used"), (100, ".making-now")):
        (tmp_path / "views" / name).mkdir(parents=True)
        os.utime(tmp_path / "views" / name, (time.time() - age_s,) * 2)

    async def ask() -> None:
        made = folders(tmp_path)
        assert (await made.prepare("older-but-used", request_body)).state == "ready"
        await made.path("key", request_body)

    asyncio.run(ask())
    assert names(tmp_path) == [".making-now", "key", "older-but-used"]


def test_what_fails_says_why_and_is_tried_again_later(
    tmp_path: Path, request_body: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    async def ask() -> None:
        made = folders(tmp_path)
        with pytest.raises(DatasetNotFound):
            await made.path("key", request_body | {"dataset": "gone"})
        failed = await made.prepare("key", request_body)
        assert failed.state == "failed"
        assert isinstance(failed.error, DatasetNotFound)
        monkeypatch.setattr(prepared, "_FAILURE_KEPT_S", 0.0)
        assert (await made.prepare("key", request_body)).state == "running"
        await made.path("key", request_body)

    asyncio.run(ask())
    assert names(tmp_path) == ["key"]


def test_what_is_stopped_or_killed_leaves_nothing(tmp_path: Path, request_body: dict[str, str]) -> None:
    async def stop() -> None:
        made = folders(tmp_path)
        asking = asyncio.ensure_future(made.path("key", request_body))
        while not (tmp_path / "views").is_dir() or not names(tmp_path):
            await asyncio.sleep(0.01)
        made.end()
        with pytest.raises(asyncio.CancelledError):
            await asking

    asyncio.run(stop())
    assert names(tmp_path) == []


def test_what_dead_services_left_is_removed(tmp_path: Path) -> None:
    for age_s, name in ((2 * prepared.TIMEOUT_S, ".making-dead"), (1, ".making-alive"), (9999, "kept")):
        (tmp_path / "views" / name).mkdir(parents=True)
        os.utime(tmp_path / "views" / name, (time.time() - age_s,) * 2)
    asyncio.run(folders(tmp_path).remove_stale())
    assert names(tmp_path) == [".making-alive", "kept"]


def test_memory_beyond_the_limit_is_one_clear_error(tmp_path: Path, request_body: dict[str, str]) -> None:
    images = tmp_path / "datasets" / "tiny" / "files" / "images_train.npy"
    with images.open("wb") as file:
        shape = (2000, 512, 512)
        np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": shape})
        file.truncate(file.tell() + 4 * 2000 * 512 * 512)  # a hole: nothing is written
    settings = Settings(data_folder=tmp_path, dataset_memory_mb=512)
    limited = PreparedFolders(tmp_path / "views", "dataset_view", "laying out", settings)
    with pytest.raises(MemoryExceeded) as caught:
        asyncio.run(limited.path("key", request_body))
    assert "512 MiB" in caught.value.detail


def test_another_service_may_be_quicker(tmp_path: Path, request_body: dict[str, str]) -> None:
    async def ask() -> list[Path]:
        return await asyncio.gather(*(folders(tmp_path).path("key", request_body) for _ in range(2)))

    assert asyncio.run(ask()) == [tmp_path / "views" / "key"] * 2
    assert names(tmp_path) == ["key"]

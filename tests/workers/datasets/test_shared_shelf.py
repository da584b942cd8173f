"""Datasets that hosts share: one write makes a dataset, a host fetches it once, and what is damaged is not used."""

from __future__ import annotations

import json
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from ultragray_workers.datasets.shared_shelf import FILES, SharedShelf

from ultragray.errors import DatasetInvalid
from ultragray_workers import shared_claims
from ultragray_workers.datasets import shared_shelf
from ultragray_workers.datasets.incoming import IncomingDataset
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import DatasetExists, DatasetInUse, DatasetNotFound
from ultragray_workers.storage.copies import LocalCopies
from ultragray_workers.storage.local import LocalStorage
from ultragray_workers.storage.storage import Storage

from ..jobs.conftest import store_dataset, tiny_dataset


@pytest.fixture
def storage(tmp_path: Path) -> LocalStorage:
    return LocalStorage(tmp_path / "bucket")


@pytest.fixture
def on_host(tmp_path: Path, storage: LocalStorage) -> Callable[[str], DatasetStore]:
    """The datasets as a host of that name sees them."""
    return lambda name: DatasetStore(tmp_path / name, storage)


@pytest.fixture
def complete(tmp_path: Path) -> Callable[[str], Path]:
    """A folder as a checked upload leaves it, on a host of that name."""

    def make(host: str) -> Path:
        made = store_dataset(tmp_path / host / "arriving", "tiny")
        (made / "contact_sheet.png").write_bytes(b"\x89PNG")
        return made

    return make


def keys(storage: Storage, prefix: str) -> set[str]:
    return {entry.key for entry in storage.entries(prefix)}


OnHost = Callable[[str], DatasetStore]
Complete = Callable[[str], Path]


def test_what_one_host_adds_another_reads(on_host: OnHost, complete: Complete) -> None:
    one, two = on_host("one"), on_host("two")
    record, is_new = one.add(complete("one"), "tiny")
    assert is_new
    assert (two.names(), two.get("tiny")) == (["tiny"], record)
    assert two.load("tiny").sha256 == tiny_dataset().sha256
    assert two.contact_sheet("tiny").read_bytes() == b"\x89PNG"


def test_of_two_hosts_that_add_a_name_one_wins(on_host: OnHost, complete: Complete, storage: LocalStorage) -> None:
    one, two = on_host("one"), on_host("two")
    one.add(complete("one"), "tiny")
    files = keys(storage, FILES)
    assert two.add(complete("two"), "tiny") == (one.get("tiny"), False)
    other = complete("three")
    manifest = json.loads((other / "dataset.json").read_text())
    (other / "dataset.json").write_text(json.dumps({**manifest, "sha256": "0" * 64}))
    with pytest.raises(DatasetExists):
        two.add(other, "tiny")
    assert keys(storage, FILES) == files  # the losers left nothing


def test_a_dataset_is_fetched_once(
    on_host: OnHost, complete: Complete, storage: LocalStorage, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_host("one").add(complete("one"), "tiny")
    fetched: list[str] = []
    download = storage.download
    monkeypatch.setattr(
        storage, "download", lambda key, *rest, **more: fetched.append(key) or download(key, *rest, **more)
    )
    two = on_host("two")
    two.load("tiny")
    assert sorted(fetched) == sorted(keys(storage, FILES))
    two.load("tiny")
    on_host("two").load("tiny")  # another process of the host
    assert len(fetched) == len(set(fetched))


def test_a_file_that_was_changed_in_the_storage_is_not_used(
    on_host: OnHost, complete: Complete, storage: LocalStorage
) -> None:
    on_host("one").add(complete("one"), "tiny")
    key = next(key for key in keys(storage, FILES) if key.endswith(".npy"))
    storage.write(key, b"another")
    with pytest.raises(DatasetInvalid, match="not what was uploaded"):
        on_host("two").load("tiny")


def test_a_deletion_takes_the_name_first_and_leaves_nothing(
    on_host: OnHost, complete: Complete, storage: LocalStorage
) -> None:
    one, two = on_host("one"), on_host("two")
    one.add(complete("one"), "tiny")
    asked: list[list[str]] = []

    def in_use(name: str) -> str | None:
        asked.append(on_host("three").names())
        return "a job" if len(asked) == 2 else None

    two.in_use = in_use
    with pytest.raises(DatasetInUse):  # a job came in between
        two.delete("tiny")
    assert asked == [["tiny"], []]
    assert one.load("tiny").sha256 == tiny_dataset().sha256
    two.delete("tiny")
    assert keys(storage, "") == set()
    with pytest.raises(DatasetNotFound):
        one.load("tiny")


def test_files_without_a_manifest_go_after_a_day(
    on_host: OnHost, complete: Complete, storage: LocalStorage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_host("one").add(complete("one"), "tiny")
    named = keys(storage, FILES)
    storage.write(f"{FILES}/of-a-service-that-died/files/a.npy", b"half")
    shelf = SharedShelf(storage, tmp_path / "one")
    assert shelf.remove_stray_files() == 0
    monkeypatch.setattr(shared_shelf, "_STRAY_AFTER_S", -1.0)
    assert shelf.remove_stray_files() == 1
    assert keys(storage, FILES) == named


def test_an_upload_is_claimed_for_the_other_hosts_as_long_as_its_service_lives(
    on_host: OnHost, storage: LocalStorage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared_claims, "DEAD_AFTER_S", 4.0)
    monkeypatch.setattr(shared_claims, "REFRESH_S", 0.1)
    one, two = on_host("one"), on_host("two")
    incoming = IncomingDataset(one, 1000)
    token = incoming.folder.name
    time.sleep(4.5)
    assert two.shelf.is_claimed(token)
    claim = storage.read(f"claims/{token}")
    incoming.discard()
    assert not two.shelf.is_claimed(token)
    storage.write(f"claims/{token}", claim)  # as a service that is killed leaves it
    assert two.shelf.is_claimed(token)
    time.sleep(4.5)
    assert not two.shelf.is_claimed(token)


def test_copies_make_room_but_for_those_in_use(tmp_path: Path) -> None:
    copies = LocalCopies(tmp_path, max_bytes=25)

    def fetch(folder: Path) -> None:
        (folder / "file").write_bytes(bytes(10))

    with copies.held("used", fetch) as used:
        for name in ("old", "newer", "newest"):
            with copies.held(name, fetch):
                time.sleep(0.02)
        assert (used / "file").exists()
        assert not (used.parent.parent / "old").exists()
        assert (used.parent.parent / "newest").exists()


def test_processes_that_want_one_copy_get_the_same(tmp_path: Path) -> None:
    found: list[int] = []

    def use() -> None:
        with LocalCopies(tmp_path).held("one", lambda folder: (folder / "file").touch()) as folder:
            found.append((folder / "file").stat().st_ino)

    threads = [threading.Thread(target=use) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(found)) == 1
    assert len(found) == 8
    shutil.rmtree(tmp_path)

"""What a folder and a bucket promise alike."""

import errno
import os
from concurrent.futures import ThreadPoolExecutor

import pytest

from ultragray.errors import InvalidArgument
from ultragray_workers.storage.local import LocalStorage
from ultragray_workers.storage.storage import NotThere

LARGE = 17 * 2**20  # uploaded in parts


def test_an_object_is_written_read_and_deleted(storage):
    assert storage.entry("a/b.json") is None
    assert storage.write("a/b.json", b"0123456789")
    assert storage.read("a/b.json") == b"0123456789"
    assert storage.read("a/b.json", start=2, length=3) == b"234"
    assert storage.read("a/b.json", start=8) == b"89"
    assert storage.read("a/b.json", start=8, length=5) == b"89"
    assert storage.read("a/b.json", start=10, length=5) == storage.read("a/b.json", start=99) == b""
    entry = storage.entry("a/b.json")
    assert (entry.key, entry.bytes) == ("a/b.json", 10)
    storage.delete("a/b.json")
    storage.delete("a/b.json")
    assert storage.entry("a/b.json") is None
    with pytest.raises(NotThere, match=r"no a/b\.json in"):
        storage.read("a/b.json")


def test_entries_are_those_below_whole_parts_of_a_path(storage):
    assert list(storage.entries()) == []
    for key in ("jobs/a", "jobs/b/c", "jobs2/d", "e"):
        storage.write(key, b"x")
    assert {entry.key for entry in storage.entries("jobs")} == {"jobs/a", "jobs/b/c"}
    assert {entry.key for entry in storage.entries()} == {"jobs/a", "jobs/b/c", "jobs2/d", "e"}
    assert {entry.key for entry in storage.entries_in("jobs")} == {"jobs/a"}
    assert {entry.key for entry in storage.entries_in()} == {"e"}
    assert list(storage.entries_in("absent")) == []
    (listed,) = (entry for entry in storage.entries() if entry.key == "e")
    assert listed == storage.entry("e")


def test_a_write_can_ask_that_there_is_none(storage):
    assert storage.write("a", b"first", if_absent=True)
    assert not storage.write("a", b"second", if_absent=True)
    assert storage.read("a") == b"first"
    assert storage.write("a", b"first", if_absent=True)  # as if its answer had been lost


def test_of_many_that_write_at_once_one_wins(storage):
    with ThreadPoolExecutor(8) as threads:
        won = list(threads.map(lambda n: storage.write("a", b"%d" % n, if_absent=True), range(8)))
        assert won.count(True) == 1
    assert storage.read("a") == b"%d" % won.index(True)


@pytest.mark.parametrize("size", [0, 1000, LARGE])
def test_files_are_uploaded_and_downloaded_whole(storage, size, tmp_path):
    content = os.urandom(size)
    (tmp_path / "source").write_bytes(content)
    assert storage.upload(tmp_path / "source", "made/it", if_absent=True)
    assert storage.read("made/it") == content
    entry = storage.download("made/it", tmp_path / "copy")
    assert entry == storage.entry("made/it")
    assert (tmp_path / "copy").read_bytes() == content
    (tmp_path / "other").write_bytes(b"other" * (size // 5 + 1))
    assert not storage.upload(tmp_path / "other", "made/it", if_absent=True)
    assert storage.upload(tmp_path / "other", "made/it")
    assert storage.read("made/it", length=5) == b"other"
    with pytest.raises(NotThere, match="no longer of the version"):
        storage.download("made/it", tmp_path / "late", version=entry.version)
    assert not (tmp_path / "late").exists()
    with pytest.raises(NotThere):
        storage.download("absent", tmp_path / "late")
    assert {path.name for path in tmp_path.iterdir()} - {"storage"} == {"source", "copy", "other"}
    assert {entry.key for entry in storage.entries()} == {"made/it"}


@pytest.mark.parametrize("key", ["", "/a", "a//b", "../a", "a/..", "a/", "a\0b", "k" * 1025])
def test_keys_that_no_object_can_have_are_refused(storage, key):
    with pytest.raises(InvalidArgument, match="a key must be"):
        storage.write(key, b"x")
    with pytest.raises(InvalidArgument, match="a key must be"):
        storage.read(key)


def test_a_folder_without_links_keeps_the_promises(tmp_path, monkeypatch):
    def refuse(*arguments):
        raise OSError(errno.EPERM, "no links here")

    monkeypatch.setattr(os, "link", refuse)
    storage = LocalStorage(tmp_path / "storage")
    assert storage.write("a", b"first", if_absent=True)
    assert not storage.write("a", b"second", if_absent=True)
    (tmp_path / "file").write_bytes(b"content")
    assert storage.upload(tmp_path / "file", "b", if_absent=True)
    assert not storage.upload(tmp_path / "file", "a", if_absent=True)
    assert (storage.read("a"), storage.read("b")) == (b"first", b"content")


def test_what_a_killed_writer_left_is_removed(tmp_path):
    storage = LocalStorage(tmp_path)
    storage.write("a/whole", b"x")
    (tmp_path / "a" / ".other.0123456789ab.tmp").write_bytes(b"half")
    storage.delete_half_written("a")
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["whole"]

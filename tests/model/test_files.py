"""Files are complete or absent, linked or copied, mapped where they are arrays."""

import errno
import hashlib
import os
import pickle

import numpy as np
import pytest

from ultragray import files
from ultragray.files import StreamedFile, atomic_path, link_or_copy, map_npy, remove_stale_temporaries, write_whole


@pytest.fixture
def umask():
    before = os.umask(0o027)
    yield
    os.umask(before)


def test_a_new_file_appears_whole_with_ordinary_permissions(tmp_path, umask):
    path = tmp_path / "scene.ugr"
    with atomic_path(path) as temporary:
        temporary.write_bytes(b"part")
        assert not path.exists()
        assert temporary.parent == tmp_path
        assert temporary.suffix != ".ugr"  # a folder watcher must not take it for a scene
    assert path.read_bytes() == b"part"
    assert path.stat().st_mode & 0o777 == 0o640
    assert os.listdir(tmp_path) == ["scene.ugr"]


def test_a_failure_keeps_the_old_file_and_leaves_nothing(tmp_path):
    path = tmp_path / "scene.ugr"
    path.write_bytes(b"old")

    def interrupted():
        with atomic_path(path) as temporary:
            temporary.write_bytes(b"half of the n")
            raise KeyError

    with pytest.raises(KeyError):
        interrupted()
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["scene.ugr"]


def test_a_file_is_hashed_and_brought_to_the_disk_while_it_is_written(tmp_path, monkeypatch):
    path, synced, dropped = tmp_path / "frames", [], []
    monkeypatch.setattr(files, "_SYNC_BYTES", 10)
    monkeypatch.setattr(os, "fdatasync", lambda descriptor: synced.append(path.stat().st_size))
    monkeypatch.setattr(os, "posix_fadvise", lambda descriptor, start, length, advice: dropped.append((start, length)))
    with StreamedFile(path) as file:
        for part in (b"head", np.arange(12, dtype=np.uint8).reshape(3, 4).data, b"", b"tail", b"of it"):
            assert file.write(part) == memoryview(part).nbytes
        assert file.tell() == 25
    assert path.read_bytes() == b"head" + bytes(range(12)) + b"tailof it"
    assert file.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert (synced, dropped) == ([16], [(0, 16)])


def test_what_a_killed_process_left_is_removed_and_nothing_else(tmp_path):
    path = tmp_path / "scene[1].ugr"
    with atomic_path(path) as temporary:
        temporary.write_bytes(b"half")
        (tmp_path / "left").write_bytes(b"half")
        stale = temporary
    (tmp_path / "left").rename(stale)
    others = [".other.ugr.abcdefgh.tmp", ".scene[1].ugr.zip.abcdefgh.tmp", "scene[1].ugr", "scene[1].ugr.tmp"]
    for name in others:
        (tmp_path / name).touch()
    remove_stale_temporaries(path)
    assert sorted(os.listdir(tmp_path)) == sorted(others)


def test_an_error_names_the_file_that_was_wanted(tmp_path):
    path = tmp_path / "none" / "scene.ugr"
    with pytest.raises(FileNotFoundError) as missing, atomic_path(path):
        raise AssertionError("its folder is not there")
    assert missing.value.filename == str(path)
    path = tmp_path / "scene.ugr"
    with pytest.raises(OSError, match="No space left") as full, atomic_path(path):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert full.value.filename == str(path)
    with pytest.raises(IsADirectoryError) as other, atomic_path(path):
        tmp_path.read_bytes()
    assert other.value.filename == str(tmp_path)
    assert os.listdir(tmp_path) == []


@pytest.fixture
def source(tmp_path):
    path = tmp_path / "source"
    path.write_bytes(b"new")
    return path


def refuse(*arguments):
    raise OSError(errno.EPERM, "no links here")


def test_one_file_with_two_names(source, tmp_path):
    (tmp_path / "symbolic").symlink_to(source)
    link_or_copy(tmp_path / "symbolic", tmp_path / "target")
    assert (tmp_path / "target").samefile(source)
    assert not (tmp_path / "target").is_symlink()


def test_copied_where_links_cannot_be(source, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "link", refuse)
    link_or_copy(source, tmp_path / "target")
    assert not (tmp_path / "target").samefile(source)
    assert (tmp_path / "target").read_bytes() == b"new"
    assert {path.name for path in tmp_path.iterdir()} == {"source", "target"}


def test_copied_from_another_file_system(source, tmp_path, monkeypatch):
    link = os.link

    def across(one, other):
        if one == source:
            raise OSError(errno.EXDEV, "another file system")
        (tmp_path / "target").write_bytes(b"meanwhile")
        link(one, other)

    monkeypatch.setattr(os, "link", across)
    link_or_copy(source, tmp_path / "target")
    assert (tmp_path / "target").read_bytes() == b"meanwhile"
    assert {path.name for path in tmp_path.iterdir()} == {"source", "target"}


@pytest.mark.parametrize("links", [True, False])
def test_what_is_there_stays(links, source, tmp_path, monkeypatch):
    if not links:
        monkeypatch.setattr(os, "link", refuse)
    (tmp_path / "target").write_bytes(b"old")
    link_or_copy(source, tmp_path / "target")
    assert (tmp_path / "target").read_bytes() == b"old"
    assert {path.name for path in tmp_path.iterdir()} == {"source", "target"}


def test_no_source(tmp_path):
    with pytest.raises(FileNotFoundError):
        link_or_copy(tmp_path / "none", tmp_path / "target")
    assert not list(tmp_path.iterdir())


def npy(path, array):
    np.save(path, array, allow_pickle=True)
    return path.read_bytes()


@pytest.mark.parametrize("array", [np.arange(6, dtype=np.uint8).reshape(1, 2, 3), np.zeros((0, 4)), np.array(2.5)])
def test_an_array_is_mapped(tmp_path, array):
    path = tmp_path / "a.npy"
    npy(path, array)
    mapped = map_npy(path)
    np.testing.assert_array_equal(mapped, array)
    assert mapped.dtype == array.dtype
    assert not mapped.flags.writeable


def test_what_is_wrong_is_named(tmp_path):
    path = tmp_path / "a.npy"
    numbers = npy(path, np.arange(6.0))
    archive = tmp_path / "a.npz"
    np.savez(archive, a=np.arange(6.0))
    for content, reason in [
        (b"", "does not start as a .npy file"),
        (b"garbage", "does not start as a .npy file"),
        (pickle.dumps([1]), "does not start as a .npy file"),
        (archive.read_bytes(), "it is an archive"),
        (numbers[:-3], "it is truncated: 3 bytes are missing"),
        (numbers[:20], "header is damaged or truncated"),
        (numbers[:6], "header is damaged or truncated"),
        (numbers.replace(b"(6,)", b"(-6)"), "header is damaged or truncated"),
        (numbers.replace(b"(6,),", b"(-6,)"), "header is damaged or truncated"),
        (numbers.replace(b"(6,)", b"[{}:"), "header is damaged or truncated"),
        (numbers.replace(b"{", b"("), "header is damaged or truncated"),
        (numbers.replace(b"(6,), }                 ", b"(0, 9223372036854775808)}"), "header is damaged or truncated"),
        (npy(path, np.array([[1], None], dtype=object)), "holds Python objects"),
    ]:
        path.write_bytes(content)
        with pytest.raises(ValueError, match=reason) as caught:
            map_npy(path)
        assert "pickle" not in str(caught.value)


def test_who_reads_a_file_while_it_is_written_whole_keeps_what_was_there(tmp_path):
    path = tmp_path / "file"
    write_whole(path, "before")
    with path.open() as reader:
        write_whole(path, "after")
        assert reader.read() == "before"
    assert path.read_text() == "after"

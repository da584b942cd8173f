"""Files are complete or absent."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from ultragray.files import atomic_path, remove_stale_temporaries, write_whole


@pytest.fixture
def umask() -> Iterator[None]:
    before = os.umask(0o027)
    yield
    os.umask(before)


def test_a_new_file_appears_whole_with_ordinary_permissions(tmp_path: Path, umask: None) -> None:
    path = tmp_path / "scene.ugr"
    with atomic_path(path) as temporary:
        temporary.write_bytes(b"part")
        assert not path.exists()
        assert temporary.parent == tmp_path
        assert temporary.suffix != ".ugr"  # a folder watcher must not take it for a scene
    assert path.read_bytes() == b"part"
    assert path.stat().st_mode & 0o777 == 0o640
    assert os.listdir(tmp_path) == ["scene.ugr"]


def test_a_failure_keeps_the_old_file_and_leaves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "scene.ugr"
    path.write_bytes(b"old")

    def interrupted() -> None:
        with atomic_path(path) as temporary:
            temporary.write_bytes(b"half of the n")
            raise KeyError

    with pytest.raises(KeyError):
        interrupted()
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["scene.ugr"]


def test_a_missing_folder_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), atomic_path(tmp_path / "nowhere" / "scene.ugr"):
        pass


def test_what_a_killed_process_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
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


def test_an_error_names_the_file_that_was_wanted(tmp_path: Path) -> None:
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


def test_who_reads_a_file_while_it_is_written_whole_keeps_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_whole(path, "before")
    with path.open() as reader:
        write_whole(path, "after")
        assert reader.read() == "before"
    assert path.read_text() == "after"

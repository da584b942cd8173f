import errno
import os

import pytest

from ultragray.files import link_or_copy


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

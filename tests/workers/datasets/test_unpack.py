import io
import tarfile
import zipfile

import pytest

from ultragray.errors import DatasetInvalid
from ultragray_workers.datasets import unpack as dataset_unpack
from ultragray_workers.datasets.unpack import unpack
from ultragray_workers.errors import UploadTooLarge

LIMIT_BYTES = 100_000


def zip_of(path, entries):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    return path


def tar_of(path, entries, mode="w"):
    with tarfile.open(path, mode) as archive:
        for name, content in entries.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            archive.addfile(entry, io.BytesIO(content))
    return path


def zip_with_link(path):
    entry = zipfile.ZipInfo("link")
    entry.external_attr = 0o120777 << 16
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(entry, "/etc/passwd")
    return path


def tar_with(kind):
    def make(path):
        entry = tarfile.TarInfo("entry")
        entry.type, entry.linkname = kind, "../../outside"
        with tarfile.open(path, "w") as archive:
            archive.addfile(entry)
        return path

    return make


def files_below(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def target(tmp_path):
    folder = tmp_path / "deep" / "files"
    folder.mkdir(parents=True)
    return folder


CONTENT = {"liver/conf.json": b"{}", "liver/data/images.npy": b"\0" * 50_000, "./plain": b""}


@pytest.mark.parametrize(
    "make",
    [zip_of, tar_of, lambda path, entries: tar_of(path, entries, "w:gz")],
    ids=["zip", "tar", "tar.gz"],
)
def test_every_kind_gives_the_same_files(make, tmp_path, target):
    unpack(make(tmp_path / "archive", CONTENT), target, LIMIT_BYTES)
    assert files_below(target) == {name.removeprefix("./"): content for name, content in CONTENT.items()}


@pytest.mark.parametrize("make", [zip_of, tar_of])
@pytest.mark.parametrize(
    "name", ["../evil", "a/../../evil", "/evil", "..", "a\\..\\evil", "new\nline", "x" * 300, "a/" * 300 + "b"]
)
def test_paths_that_leave_the_folder_or_are_no_text(make, name, tmp_path, target):
    with pytest.raises(DatasetInvalid, match="plain paths"):
        unpack(make(tmp_path / "archive", {"good": b"1", name: b"2"}), target, LIMIT_BYTES)
    assert {path.name for path in tmp_path.rglob("*") if path.is_file()} == {"archive", "good"}


@pytest.mark.parametrize(
    "make",
    [
        zip_with_link,
        *(tar_with(kind) for kind in (tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.FIFOTYPE)),
    ],
    ids=["zip link", "link", "hard link", "device", "pipe"],
)
def test_links_and_devices(make, tmp_path, target):
    with pytest.raises(DatasetInvalid, match="no links and no devices"):
        unpack(make(tmp_path / "archive"), target, LIMIT_BYTES)
    assert not list(target.iterdir())


@pytest.mark.parametrize("make", [zip_of, lambda path, entries: tar_of(path, entries, "w:gz")], ids=["zip", "tar.gz"])
def test_a_bomb_stops_at_the_limit(make, tmp_path, target):
    archive = make(tmp_path / "archive", {"a": b"\0" * 60_000, "b": b"\0" * 20_000_000})
    assert archive.stat().st_size < LIMIT_BYTES
    with pytest.raises(UploadTooLarge, match="100000 bytes"):
        unpack(archive, target, LIMIT_BYTES)
    assert sum(len(content) for content in files_below(target).values()) <= LIMIT_BYTES


@pytest.mark.parametrize("make", [zip_of, tar_of])
def test_too_many_files(make, tmp_path, target, monkeypatch):
    monkeypatch.setattr(dataset_unpack, "MAX_FILES", 5)
    with pytest.raises(UploadTooLarge, match="at most 5 files"):
        unpack(make(tmp_path / "archive", {str(n): b"" for n in range(6)}), target, LIMIT_BYTES)


def test_folders_count_too(tmp_path, target, monkeypatch):
    monkeypatch.setattr(dataset_unpack, "MAX_ENTRIES", 5)
    with pytest.raises(UploadTooLarge, match="at most 5 entries"):
        unpack(zip_of(tmp_path / "archive", {f"{n}/": b"" for n in range(6)}), target, LIMIT_BYTES)


@pytest.mark.parametrize("make", [zip_of, lambda path, entries: tar_of(path, entries, "w:gz"), tar_of])
def test_damaged_archives(make, tmp_path, target):
    whole = make(tmp_path / "archive", {"a": bytes(range(256)) * 100}).read_bytes()
    (tmp_path / "archive").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DatasetInvalid):
        unpack(tmp_path / "archive", target, LIMIT_BYTES)


def test_a_zip_whose_directory_points_before_its_beginning(tmp_path, target):
    whole = zip_of(tmp_path / "archive", {"a": b"content"}).read_bytes()
    (tmp_path / "archive").write_bytes(whole[1:])
    with pytest.raises(DatasetInvalid, match="damaged"):
        unpack(tmp_path / "archive", target, LIMIT_BYTES)


@pytest.mark.parametrize("content", [b"", b"hello", b"\x89PNG", b"\x1f\x8b"])
def test_what_is_no_archive(content, tmp_path, target):
    (tmp_path / "archive").write_bytes(content)
    with pytest.raises(DatasetInvalid, match="archive"):
        unpack(tmp_path / "archive", target, LIMIT_BYTES)


def test_a_name_that_comes_twice(tmp_path, target):
    with pytest.raises(DatasetInvalid, match="twice"):
        unpack(tar_of(tmp_path / "archive", {"a": b"1", "./a": b"2"}), target, LIMIT_BYTES)

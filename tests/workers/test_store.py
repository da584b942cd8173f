"""The artifact folder: it gets a version, and one of another is refused, and a restore is alone in it."""

import json

import pytest

from ultragray_workers.errors import RestoreRefused, StartupFailed
from ultragray_workers.store import (
    FORMAT_VERSION,
    OpenStore,
    closed_store,
    remove_restore_marker,
    write_restore_marker,
)


def test_folder_without_a_version_gets_one(tmp_path):
    for _ in range(2):
        OpenStore(tmp_path / "artifacts").close()
    assert json.loads((tmp_path / "artifacts" / "store.json").read_text()) == {"format_version": FORMAT_VERSION}


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ('{"format_version": 2}', "has version 2 .* another release has used it; start that one, or restore a backup"),
        ("{", "is damaged: restore the folder from a backup"),
        ('{"format_version": "one"}', "is damaged"),
    ],
)
def test_folder_that_cannot_be_used_is_refused_and_let_go(content, told, tmp_path):
    (tmp_path / "store.json").write_text(content)
    with pytest.raises(StartupFailed, match=told):
        OpenStore(tmp_path)
    with closed_store(tmp_path):
        assert (tmp_path / "store.json").read_text() == content


def test_folder_is_open_to_many_or_closed_to_all(tmp_path):
    first, second = OpenStore(tmp_path), OpenStore(tmp_path)
    with pytest.raises(RestoreRefused, match="stop all of them"), closed_store(tmp_path):
        pass
    first.close()
    second.close()
    with closed_store(tmp_path), pytest.raises(StartupFailed, match="is being restored"):
        OpenStore(tmp_path)


def test_folder_is_closed_until_its_restore_has_ended(tmp_path):
    write_restore_marker(tmp_path, "20261122T070301.123Z")
    with pytest.raises(StartupFailed, match="start it again where it was interrupted"):
        OpenStore(tmp_path)
    remove_restore_marker(tmp_path)
    OpenStore(tmp_path).close()

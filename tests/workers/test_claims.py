"""Folders that are made whole: claimed while their maker lives, removed when it has died."""

import os
import shutil
import signal
import subprocess
import sys

import pytest

from ultragray_workers import claims
from ultragray_workers.claims import LOCK_NAME, claimed_folder, remove_abandoned, remove_whole, storage_full
from ultragray_workers.errors import StorageFull

HOLD = """
import sys
from pathlib import Path
from ultragray_workers.claims import claimed_folder
with claimed_folder(Path(sys.argv[1]), ".making-"):
    print(flush=True)
    sys.stdin.read()
"""


def test_a_claimed_folder_goes_with_what_is_left_in_it(tmp_path):
    with claimed_folder(tmp_path / "new", ".making-") as folder:
        assert [path.name for path in folder.iterdir()] == [LOCK_NAME]
        (folder / "part").mkdir()
        (folder / "whole").mkdir()
        (folder / "whole").rename(tmp_path / "kept")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["kept", "new"]


def test_only_what_a_dead_process_claimed_is_abandoned(tmp_path):
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    holder.stdout.readline()
    assert remove_abandoned(tmp_path, ".making-") == 0
    os.kill(holder.pid, signal.SIGKILL)
    holder.communicate()
    assert remove_abandoned(tmp_path, ".other-") == 0
    assert remove_abandoned(tmp_path, ".making-") == 1
    assert not list(tmp_path.iterdir())


def test_a_folder_without_a_lock_is_left_a_while(tmp_path, monkeypatch):
    (tmp_path / "kept" / "deep").mkdir(parents=True)
    with monkeypatch.context() as dying:
        dying.setattr(shutil, "rmtree", lambda *_, **__: None)  # the service dies while it removes
        remove_whole(tmp_path / "kept", ".making-")
    assert remove_abandoned(tmp_path, ".making-") == 0
    monkeypatch.setattr(claims, "UNLOCKED_S", 0.0)
    assert remove_abandoned(tmp_path, ".making-") == 1
    remove_whole(tmp_path / "kept", ".making-")
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_told_apart():
    with pytest.raises(StorageFull, match="no room for the dataset"), storage_full("the dataset"):
        raise OSError(28, "No space left on device")
    with pytest.raises(PermissionError), storage_full("the dataset"):
        raise PermissionError

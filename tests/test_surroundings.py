"""What the checkout's folders and the user's environment hold does not reach the tests."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from ultragray_service.settings import Settings, load_settings

from .surroundings import ROOT


def test_no_setting_and_no_folder_of_the_user_is_seen(working_folder: Path, home_of_the_tests: Path) -> None:
    assert load_settings() == Settings()
    assert Path.cwd() == working_folder
    assert not list(working_folder.iterdir())
    assert ROOT not in (working_folder, *working_folder.parents)
    assert Path.home() == home_of_the_tests


@pytest.mark.long
def test_strange_settings_in_the_environment_do_not_matter() -> None:
    strange = {
        "ULTRAGRAY_DATA_FOLDER": "/nowhere",
        "ULTRAGRAY_HTTP_PORT": "no number",
        "ULTRAGRAY_API_KEYS": "short",
        "XDG_CONFIG_HOME": "/nowhere",
        "PGHOST": "nowhere.invalid",
        "http_proxy": "http://127.0.0.1:9",
        "FORCE_COLOR": "1",
    }
    test = f"{__file__}::{test_no_setting_and_no_folder_of_the_user_is_seen.__name__}"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", test]
    done = subprocess.run(command, cwd=ROOT, env={**os.environ, **strange}, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout

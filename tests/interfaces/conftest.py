"""The service whose public names are compared."""

from __future__ import annotations

from pathlib import Path

import pytest

from ultragray_service.settings import Settings
from ultragray_service.state import Service


@pytest.fixture
def service(tmp_path: Path) -> Service:
    return Service(Settings(data_folder=tmp_path))

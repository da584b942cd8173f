"""The service whose public names are compared."""

from __future__ import annotations

from pathlib import Path

import pytest

from ultragray_service.core.state import Service
from ultragray_service.settings import Settings


@pytest.fixture
def service(tmp_path: Path) -> Service:
    return Service(Settings(data_folder=tmp_path))

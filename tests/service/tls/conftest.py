"""Certificate files as they are mounted."""

import pytest

from ...certificates import Mounted


@pytest.fixture
def mounted(tmp_path):
    return Mounted(tmp_path / "tls")

"""Certificate files as they are mounted."""

import pytest

from ...certificates import Mounted


@pytest.fixture
def mounted(tmp_path):
    found = Mounted(tmp_path / "tls")
    found.put(found.issue())
    return found

"""The tutorial as a whole. It trains a scene, so that it has a test process of its own beside the other documents."""

from __future__ import annotations

import pytest

from .conftest import TUTORIAL, RunPage


@pytest.mark.long
@pytest.mark.lengthy
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_the_tutorial_runs(run_page: RunPage) -> None:
    run_page(TUTORIAL)

"""The tutorial as a whole. It trains a scene, so that it has a test process of its own beside the other documents."""

import pytest

from .conftest import TUTORIAL


@pytest.mark.long
@pytest.mark.lengthy
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_the_tutorial_runs(run_page):
    run_page(TUTORIAL)

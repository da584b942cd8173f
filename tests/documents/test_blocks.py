"""Every code block of the documents runs, or says why not. README.md beside this file has the convention."""

import pytest

from ..surroundings import ROOT
from .conftest import DOCUMENTS, TUTORIAL

ELSEWHERE = ("CHANGELOG.md", TUTORIAL.name, "extending.md")  # no commands; in test modules of their own
HOW_TO = ROOT / "docs/howto"  # long, with services and jobs of their own


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # what a snippet leaves open is closed with its page
@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=str(path.relative_to(ROOT)), marks=[pytest.mark.long] if HOW_TO in path.parents else [])
        for path in DOCUMENTS
        if path.name not in ELSEWHERE
    ],
)
def test_blocks_run(path, run_page):
    run_page(path)

"""Every code block of the documents runs, or says why not. README.md beside this file has the convention."""

import pytest

from ..surroundings import ROOT
from .blocks import PageInvalid, read_page
from .conftest import TUTORIAL
from .running import PageRun

DOCUMENTS = sorted(
    path
    for pattern in ("*.md", "docs/**/*.md", "*/README.md", "tests/documents/README.md")
    for path in ROOT.glob(pattern)
    if path.name not in ("CHANGELOG.md", TUTORIAL.name, "extending.md")  # no commands; in test modules of their own
)

HOW_TO = ROOT / "docs/howto"  # long, with services and jobs of their own


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # what a snippet leaves open is closed with its page
@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=str(path.relative_to(ROOT)), marks=[pytest.mark.long] if HOW_TO in path.parents else [])
        for path in DOCUMENTS
    ],
)
def test_blocks_run(path, run_page):
    run_page(path)


def page_of(text, folder):
    path = folder / "page.md"
    path.write_text(text, encoding="utf-8")
    return read_page(path)


def test_commands_are_told_from_output(tmp_path):
    (block,) = page_of("```console\n$ a \\\n    b\nout $ c\n$ d '{\n}'  # isn't\nout\n```\n", tmp_path).blocks
    assert block.script() == "a \\\n    b\nd '{\n}'  # isn't\n"


def test_comments_belong_to_the_next_block(tmp_path):
    text = "<!-- needs: x -->\n\n<!-- not run: no -->\n\n```bash\nfalse\n```\n\n1. list\n\n   ```python\n   x\n   ```\n"
    page = page_of(text, tmp_path)
    assert page.needs == ("x",)
    assert [(block.not_run, block.line) for block in page.blocks] == [("no", 6), (None, 12)]


@pytest.mark.parametrize(
    "text",
    [
        *("    make serve\n", "```\nx\n```\n", "```sh\nx\n```\n"),  # in no language that is known
        "```console\nmake serve\n```\n",
        "<!-- not run -->\n```bash\nfalse\n```\n",
    ],
)
def test_what_the_convention_does_not_know_is_refused(text, tmp_path):
    with pytest.raises(PageInvalid, match=r"page\.md:1: "):
        page_of(text, tmp_path)


@pytest.mark.parametrize(
    "text",
    [
        "```console\n$ true\n$ false\n```\n",
        "```bash\nfalse | cat\n```\n",
        "```python\nx = 1\n```\n```python\nassert x == 2\n```\n",
        "```python\n>>> 1 + 1\n3\n```\n",
        "<!-- not run: wrong -->\n```python\nx =\n```\n",
        '```json\n{"a": 1,}\n```\n',
        "```toml\na = \n```\n",
        "<!-- prepare: false -->\n```python\n```\n",
    ],
)
def test_a_block_that_fails_fails_its_page(text, tmp_path):
    page = page_of(text, tmp_path)
    *before, last = page.runs
    with PageRun(page, tmp_path, None) as run:
        for block in before:
            run.run(block)
        with pytest.raises((AssertionError, SyntaxError, ValueError)):
            run.run(last)


def test_addresses_become_those_of_the_service(tmp_path):
    text = "```python\nfound = ['localhost:8000', 'localhost:50051', ('127.0.0.1', 18944), 8000]\n```\n"
    page = page_of(text, tmp_path)
    with PageRun(page, tmp_path, {"http": 1, "grpc": 2, "igtl": 3}) as run:
        run.run(*page.runs)
        assert run.names["found"] == ["localhost:1", "localhost:2", ("127.0.0.1", 3), 8000]

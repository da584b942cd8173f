"""Every code block of the documents runs, or says why not. README.md beside this file has the convention."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from ultragray.demo import copy_demo_scene

from ..service.conftest import StartService, service_starter
from ..surroundings import ROOT
from .blocks import Page, PageInvalid, read_page
from .running import PageRun

DEMO_SERVICE = "demo service"
DOCUMENTS = sorted(
    path
    for pattern in ("*.md", "docs/**/*.md", "*/README.md")
    for path in ROOT.glob(pattern)
    if path.name != "CHANGELOG.md"
)

SharedPorts = Callable[[], dict[str, int]]


@pytest.fixture(scope="module")
def start_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StartService]:
    folder = tmp_path_factory.mktemp("demo")
    copy_demo_scene(folder / "demo.ugr")
    yield from service_starter(tmp_path_factory, folder)


@pytest.fixture(scope="module")
def shared_ports(start_service: StartService) -> SharedPorts:
    """The ports of the service that the pages share, which is started by the first page that needs it."""
    found: dict[str, int] = {}

    def ports() -> dict[str, int]:
        if not found:
            service = start_service(igtl_port=0, igtl_scene="demo", embedded_worker=True)
            (record,) = (record for record in service.log() if "grpc" in record)
            found.update((door, int(record[door].rpartition(":")[2])) for door in ("http", "grpc", "igtl"))
        return found

    return ports


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_blocks_run(path: Path, shared_ports: SharedPorts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = read_page(path)
    for need in set(page.needs) - {DEMO_SERVICE}:
        if shutil.which(need) is None:
            pytest.skip(f"{need} is not installed")
    folder = tmp_path / "page"
    folder.mkdir()
    monkeypatch.chdir(folder)
    with PageRun(page, folder, shared_ports() if DEMO_SERVICE in page.needs else None) as run:
        for name, value in run.environment().items():
            monkeypatch.setenv(name, value)
        for block in page.runs:
            run.run(block)


def page_of(text: str, folder: Path) -> Page:
    path = folder / "page.md"
    path.write_text(text, encoding="utf-8")
    return read_page(path)


def test_commands_are_told_from_output(tmp_path: Path) -> None:
    (block,) = page_of("```console\n$ a \\\n    b\nout $ c\n$ d '{\n}'  # isn't\nout\n```\n", tmp_path).blocks
    assert block.script() == "a \\\n    b\nd '{\n}'  # isn't\n"


def test_comments_belong_to_the_next_block(tmp_path: Path) -> None:
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
def test_what_the_convention_does_not_know_is_refused(text: str, tmp_path: Path) -> None:
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
def test_a_block_that_fails_fails_its_page(text: str, tmp_path: Path) -> None:
    page = page_of(text, tmp_path)
    *before, last = page.runs
    with PageRun(page, tmp_path, None) as run:
        for block in before:
            run.run(block)
        with pytest.raises((AssertionError, SyntaxError, ValueError)):
            run.run(last)


def test_addresses_become_those_of_the_service(tmp_path: Path) -> None:
    text = "```python\nfound = ['localhost:8000', 'localhost:50051', ('127.0.0.1', 18944), 8000]\n```\n"
    page = page_of(text, tmp_path)
    with PageRun(page, tmp_path, {"http": 1, "grpc": 2, "igtl": 3}) as run:
        run.run(*page.runs)
        assert run.names["found"] == ["localhost:1", "localhost:2", ("127.0.0.1", 3), 8000]

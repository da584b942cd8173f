"""Every page is in the site, every link leads somewhere, every stop of the tour is there."""

import ast
import re
from html.parser import HTMLParser

import pytest

from ..surroundings import ROOT
from .conftest import DOCUMENTS

LOADING = {"script": "src", "img": "src", "iframe": "src", "source": "src", "video": "src", "link": "href"}
LEADING = {"canonical", "prev", "next", "alternate"}  # links in a page's head that load nothing


def test_every_part_is_made(generator):
    for name, make in generator("site").PARTS.items():
        assert make().strip(), f"the part {name!r} is empty"


def test_every_part_has_its_page(generator):
    site = generator("site")
    used = [name for path in (ROOT / "docs").rglob("*.md") for name in site.MARKER.findall(path.read_text("utf-8"))]
    assert sorted(used) == sorted(site.PARTS)


class Loaded(HTMLParser):
    """What a page loads when it is opened."""

    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        if tag in LOADING and not (tag == "link" and set((given.get("rel") or "").split()) & LEADING):
            self.found.append(given.get(LOADING[tag]) or "")
        self.found += re.findall(r"url\(([^)]+)\)", given.get("style") or "")


@pytest.mark.long
def test_the_site_builds_and_loads_nothing_from_elsewhere(generator, tmp_path):
    pytest.importorskip("zensical", reason="zensical is not installed: pip install '.[docs]'")
    site = generator("site").build(tmp_path)
    pages = list(site.rglob("*.html"))
    assert len(pages) > len(generator("site").pages_of(ROOT))  # and the page that is shown for lost ones
    foreign = re.compile(r"^['\"]?(https?:)?//")
    for page in pages:
        loaded = Loaded()
        loaded.feed(page.read_text(encoding="utf-8"))
        assert loaded.found
        assert not [source for source in loaded.found if foreign.match(source)], page
    for sheet in site.rglob("*.css"):
        sources = re.findall(r"(?:url\(|@import )\s*(?!url)([^)\s;]+)", sheet.read_text(encoding="utf-8"))
        assert not [source for source in sources if foreign.match(source)], sheet


LINK = re.compile(r"\]\(([^)\s]+)\)")
CODE = re.compile(r"^```.*?^```|`[^`\n]*`", re.MULTILINE | re.DOTALL)


def anchor_of(heading):
    """The name that a page gives a heading: its words in lower case, without marks, joined by hyphens."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def headings_of(document):
    return {anchor_of(found) for found in re.findall(r"^#+ (.*)$", document.read_text(encoding="utf-8"), re.MULTILINE)}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_link_leads_somewhere(document):
    links = LINK.findall(CODE.sub("", document.read_text(encoding="utf-8")))
    for link in links:
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        target = document.parent / path if path else document
        assert target.exists(), f"{document.name} names {link}, and there is no {path}"
        if anchor and "<!-- generated: " not in target.read_text(encoding="utf-8"):  # else the site's build looks
            assert anchor in headings_of(target), f"{document.name} names {link}; {target.name} has no such heading"


TOUR = ROOT / "docs" / "tour.md"
STOP = re.compile(r"^(\d+)\. \[(?P<shown>[^]]+)\]\(\.\./(?P<path>[^)]+)\): `(?P<name>[\w.]+)`\.", re.MULTILINE)


def stops():
    """Path and function of the stops of each flow."""
    flows = TOUR.read_text(encoding="utf-8").split("\n## ")[1:]
    return {flow.partition("\n")[0]: [(one["path"], one["name"]) for one in STOP.finditer(flow)] for flow in flows}


@pytest.mark.parametrize("flow", stops())
def test_a_flow_has_twelve_stops_that_are_there(flow):
    found = stops()[flow]
    assert len(found) == 12
    for path, name in found:
        scope = ast.parse((ROOT / path).read_text(encoding="utf-8")).body
        for part in name.split("."):
            definitions = [one for one in scope if getattr(one, "name", None) == part]
            assert definitions, f"{path} has no {name}"
            scope = definitions[-1].body

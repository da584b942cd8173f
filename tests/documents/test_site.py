"""The site: every page is in it, every part is made and used, and nothing is loaded from elsewhere."""

import re
from html.parser import HTMLParser

import pytest

from ..surroundings import ROOT

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

"""The site: every page is in it, every part is made and used, and nothing is loaded from elsewhere."""

import re
import subprocess
from html.parser import HTMLParser
from pathlib import Path

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


def test_an_unknown_part_is_refused(generator):
    site = generator("site")
    with pytest.raises(site.SiteInvalid, match=r"a\.md: there is no part 'x'"):
        site.with_parts("<!-- generated: x -->\n", {}, Path("a.md"))


def test_a_page_in_no_section_is_refused(generator, tmp_path, monkeypatch):
    site = generator("site")
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "lost.md").touch()
    monkeypatch.setattr(site, "ROOT", tmp_path)
    with pytest.raises(site.SiteInvalid, match=r"lost\.md: in no section"):
        site.build(tmp_path / "build")


def test_links_hold_in_the_site(generator, tmp_path):
    root, site = tmp_path / "root", tmp_path / "site"
    (root / "docs" / "howto").mkdir(parents=True)
    (root / "docs" / "a.png").write_bytes(b"")
    (root / "script.py").touch()
    (root / "README.md").write_text(
        "[one](docs/howto/one.md#x) [![p](docs/a.png)](docs/howto/one.md) [`run`](script.py)\n"
    )
    (root / "docs" / "howto" / "one.md").write_text(
        "[home](../../README.md) [lost](lost.md) [out](https://a.example)\n"
    )
    generator("site").write_pages(root, site, {})
    assert (site / "index.md").read_text() == ("[one](howto/one.md#x) [![p](a.png)](howto/one.md) `run`\n")
    assert (site / "howto" / "one.md").read_text() == "[home](../index.md) [lost](lost.md) [out](https://a.example)\n"
    assert (site / "a.png").exists()


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


@pytest.mark.parametrize("target", ["docs/lost.md", "#lost", "docs/access.md#lost"])
def test_a_link_that_leads_nowhere_stops_the_build(target, generator, tmp_path, monkeypatch):
    pytest.importorskip("zensical", reason="zensical is not installed: pip install '.[docs]'")
    site, root = generator("site"), tmp_path / "root"
    (root / "docs").mkdir(parents=True)
    (root / "README.md").write_text(f"# Home\n\n[link]({target})\n")
    (root / "docs" / "access.md").write_text("# A page\n")
    monkeypatch.setattr(site, "ROOT", root)
    with pytest.raises(subprocess.CalledProcessError):
        site.build(tmp_path / "build")


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

"""Every link of a document leads to a file that is there, and to a heading that it has, in the repository too."""

import re

import pytest

from ..surroundings import ROOT

DOCUMENTS = sorted(
    path
    for pattern in ("*.md", "docs/**/*.md", "*/README.md", "tests/documents/README.md")
    for path in ROOT.glob(pattern)
)
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

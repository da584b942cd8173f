"""The HTTP interface is what the committed document says: `make generate`, and read the difference."""

from difflib import unified_diff


def test_the_openapi_document_is_current(generator):
    snapshots = generator("snapshots")
    before, now = snapshots.OPENAPI.read_text(encoding="utf-8"), snapshots.openapi()
    assert not "".join(unified_diff(before.splitlines(True), now.splitlines(True), "committed", "the code", n=0))

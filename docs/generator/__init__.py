"""Builds the site from README.md and docs/: `python -m docs.generator`, or `make docs`.

Where a page says `<!-- generated: NAME -->`, a part follows from the code; `parts.PARTS` says what makes it.
"""

"""Runs the code blocks of a page against the service on the ports that the documents name: run_page.py PAGE FOLDER.

With the Python of the checkout, which holds what `make serve` installed and no more.
"""

import os
import sys
from pathlib import Path

from ..documents.blocks import read_page
from ..documents.running import PORTS, PageRun


def main(page, folder):
    folder.mkdir()
    os.chdir(folder)
    with PageRun(read_page(page), folder, {door: int(port) for port, door in PORTS.items()}) as run:
        os.environ.update(run.environment())
        for block in run.page.runs:
            run.run(block)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))

"""The console in Chromium against a real service: one view in `make test`, all of them in `make test-console`."""

import gzip
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
CHROMIUM = os.environ.get("ULTRAGRAY_TEST_CHROMIUM", "/usr/bin/chromium")
BUILT = ROOT / "service/ultragray_service/console"
MAX_BUNDLE_BYTES = 405_000  # gzipped, all languages and views, of which a page loads what it shows
IN_EVERY_RUN = "key.test.mjs"
TIMEOUT_S = 3600.0
MIN_NODE = 20


def missing():
    """What the tests need and this machine lacks, in words."""
    node = shutil.which("node")
    if node is None:
        return f"the console's tests need Node {MIN_NODE} or newer"
    version = subprocess.run([node, "--version"], capture_output=True, text=True, check=True).stdout.strip()
    if int(version.removeprefix("v").split(".")[0]) < MIN_NODE:
        return f"the console's tests need Node {MIN_NODE} or newer, got {version}"
    if not Path(CHROMIUM).is_file():
        return f"the console's tests need Chromium at {CHROMIUM}; ULTRAGRAY_TEST_CHROMIUM names another place"
    if not (ROOT / "web/node_modules/playwright-core").is_dir():
        return "the console's tests need its packages: make console"
    if not (BUILT / "index.html").is_file():
        return "the console is not built: make console"
    return None


@pytest.fixture(autouse=True)
def _needs():
    reason = missing()
    if reason is not None:
        pytest.skip(reason)


def test_bundle_is_small():
    files = [path for path in BUILT.rglob("*") if path.is_file()]
    total = sum(len(gzip.compress(path.read_bytes())) for path in files)
    assert 0 < total < MAX_BUNDLE_BYTES


@pytest.mark.lengthy
@pytest.mark.slow
def test_view_of_every_run():
    outcome = subprocess.run(
        ["node", "--test", "--test-reporter=spec", str(HERE / IN_EVERY_RUN)],
        env={**os.environ, "ULTRAGRAY_TEST_PYTHON": sys.executable},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )
    assert outcome.returncode == 0, outcome.stdout + outcome.stderr

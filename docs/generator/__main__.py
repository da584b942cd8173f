"""`python -m docs.generator` builds the site into build/site."""

from __future__ import annotations

import subprocess
import sys

from .site import SiteInvalid, build

try:
    site = build()
except SiteInvalid as error:
    sys.exit(f"error: {error}")
except subprocess.CalledProcessError as error:
    sys.exit(error.returncode)
sys.stdout.write(f"The site is in {site}. To read it: python3 -m http.server --directory {site}\n")

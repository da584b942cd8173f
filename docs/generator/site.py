"""The site: its order, its configuration, and its build with Zensical."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from .pages import SiteInvalid, pages_of, write_pages
from .parts import PARTS

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "build"

# The pages of each section, in their order; a pattern stands for those that are not named.
SECTIONS: Mapping[str, tuple[str, ...]] = {
    "Home": ("index.md",),
    "Tutorial": ("tutorial.md",),
    "How-to": (
        *("howto/robotics.md", "howto/ros.md", "howto/simulator.md", "howto/data-science.md", "howto/sonographer.md"),
        *(
            "howto/recording.md",
            "howto/mcap.md",
            "howto/compare.md",
            "howto/contact.md",
            "howto/tools.md",
            "howto/gymnasium.md",
            "howto/notebooks.md",
            "howto/operator.md",
            "howto/*.md",
        ),
    ),
    "Concepts": (
        *("concepts/frame.md", "physics.md", "concepts/training.md", "concepts/jobs.md", "confidence.md"),
        *("concepts/limits.md", "poses.md"),
        "concepts/methods.md",
        "concepts/*.md",
    ),
    "Operation": ("operation.md", "scaling.md", "access.md", "tls.md", "backup.md"),
    "Results": ("results.md", "performance.md"),
    "Reference": (
        *("reference/index.md", "reference/command-line.md", "reference/http.md", "reference/stream.md"),
        *("reference/grpc.md", "reference/openigtlink.md", "reference/client.md", "reference/python.md"),
        *("reference/frames.md", "reference/export-formats.md", "reference/samplers.md", "reference/datasets.md"),
        *("reference/scene-file.md", "reference/training.md", "reference/jobs.md", "reference/settings.md"),
        *("reference/metrics.md", "reference/errors.md"),
    ),
    "Contributing": ("contributing.md", "extending.md", "libraries.md", "security.md", "changelog.md"),
}
_CONFIGURATION = """
[project]
site_name = "UltraG-Ray"
site_description = "Ultrasound simulation from trained 3D Gaussian scenes"
docs_dir = "pages"
site_dir = "site"
use_directory_urls = false
extra_css = ["site.css"]
nav = [
{nav}
]

[project.theme]
variant = "modern"
font = false
language = "en"
features = [
    "navigation.tabs", "navigation.indexes", "navigation.top", "navigation.footer",
    "content.code.copy", "search.highlight", "toc.follow",
]

[[project.theme.palette]]
media = "(prefers-color-scheme: light)"
scheme = "default"
toggle.icon = "lucide/sun"
toggle.name = "Dark"

[[project.theme.palette]]
media = "(prefers-color-scheme: dark)"
scheme = "slate"
toggle.icon = "lucide/moon"
toggle.name = "Light"

[project.extra]
generator = false
"""


def order(pages: set[str]) -> dict[str, list[str]]:
    """The pages of each section. Raises SiteInvalid for a page that is in none."""
    left = set(pages)
    found: dict[str, list[str]] = {}
    for section, patterns in SECTIONS.items():
        for pattern in patterns:
            those = sorted(page for page in left if Path(page).match(pattern) and page.count("/") == pattern.count("/"))
            found.setdefault(section, []).extend(those)
            left -= set(those)
    if left:
        raise SiteInvalid(f"{', '.join(sorted(left))}: in no section of docs/generator/site.py")
    return {section: those for section, those in found.items() if those}


def build(folder: Path = FOLDER) -> Path:
    """The site in `folder`/site, made of `folder`/pages. Raises CalledProcessError where a link leads nowhere."""
    pages, site = folder / "pages", folder / "site"
    for old in (pages, site):
        shutil.rmtree(old, ignore_errors=True)
    write_pages(ROOT, pages, PARTS)
    shutil.copyfile(Path(__file__).with_name("site.css"), pages / "site.css")
    sections = order({place.as_posix() for place in pages_of(ROOT).values()})
    nav = ",\n".join(
        f"    {{ {json.dumps(section)} = {json.dumps(those[0] if len(those) == 1 else those)} }}"
        for section, those in sections.items()
    )
    (folder / "zensical.toml").write_text(_CONFIGURATION.format(nav=nav), encoding="utf-8")
    subprocess.run([sys.executable, "-m", "zensical", "build", "--strict"], cwd=folder, check=True)
    return site

"""The site: the documents of the repository with their generated parts, and links that hold there, built by Zensical.

`<!-- generated: NAME -->` in a document asks for a part; PARTS says which there are.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from ultragray.exchange import page
from ultragray.phantom.demo import DEMO_FILE
from ultragray.rendering.display import Display
from ultragray.rendering.settings import RenderSettings, SettingsUsed
from ultragray.rendering.volumes import SliceSettings
from ultragray.scene.confidence import Extrapolation
from ultragray.scene.info import SceneInfo
from ultragray_service.http.bodies import RealFrameHeader, RenderBody, Stamps, StreamMessage
from ultragray_service.http.routes.streams import FrameMessage
from ultragray_studies.gym import ScanSettings

from . import interfaces, product, python_api

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "build"
CONFIGURATION = Path(__file__).with_name("zensical.toml")
DEMO = "demo"  # the folder of the demo scene's page in the site


def demo_page() -> str:
    """A link for documents in a folder of docs/; the page is no document, whose links would be checked."""
    if page.is_built():
        return f'<a href="../{DEMO}/index.html">The demo scene, rendered by your browser</a>'
    return "*(This site was built without `make browser` before, so that the demo scene's page is not part of it.)*"


PARTS: dict[str, Callable[[], str]] = {
    "demo page": demo_page,
    "outputs": product.outputs,
    "formats": product.formats,
    "npz": product.npz,
    "samplers": product.samplers,
    "methods": product.methods,
    "training settings": product.training_settings,
    "scene metadata": partial(product.keys, SceneInfo),
    "display": partial(product.keys, Display, "Setting"),
    "environments": partial(product.keys, ScanSettings, "Argument"),
    "confidence": partial(product.told, Extrapolation, "Figure"),
    "settings used": partial(product.told, SettingsUsed, "Setting"),
    "render body": partial(product.keys, RenderBody),
    "slice body": partial(product.keys, SliceSettings),
    "stream messages": partial(product.keys, StreamMessage),
    "real frames": partial(product.keys, RealFrameHeader),
    "stamps": partial(product.keys, Stamps),
    "stream settings": partial(product.keys, RenderSettings),
    "stream frames": partial(product.told, FrameMessage),
    "settings": product.settings,
    "errors": product.error_reasons,
    "client errors": product.client_error_reasons,
    "metrics": product.metrics,
    "limits": product.fixed_limits,
    "OpenIGTLink limits": product.igtl_limits,
    "routes": interfaces.routes,
    "render headers": interfaces.render_headers,
    "objects": interfaces.objects,
    "contract": interfaces.contract,
    "commands": python_api.commands,
    "library": partial(python_api.package, "ultragray"),
    "library modules": python_api.modules,
    "client": partial(python_api.package, "ultragray_client"),
    "client groups": python_api.client_groups,
}
# Documents outside docs/, by their place in the site.
ADOPTED = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "CHANGELOG.md": "changelog.md",
}
MARKER = re.compile(r"^<!-- generated: ([\w -]+) -->$", flags=re.MULTILINE)
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")
_SOURCE = re.compile(r"(<img [^>]*src=\")([^\"]+)(\")")


class SiteInvalid(Exception):
    """A document that cannot become a page."""


def pages_of(root: Path) -> dict[Path, Path]:
    """Where each document of the repository lies in the site; both paths are relative."""
    docs = {path.relative_to(root): path.relative_to(root / "docs") for path in (root / "docs").rglob("*.md")}
    return docs | {Path(name): Path(place) for name, place in ADOPTED.items() if (root / name).exists()}


def write_pages(root: Path, folder: Path, parts: Mapping[str, Callable[[], str]]) -> None:
    """Writes all pages into a folder, with the pictures that they show. Raises SiteInvalid for an unknown part."""
    places = pages_of(root)
    for document, place in places.items():
        text = with_parts((root / document).read_text(encoding="utf-8"), parts, document)
        target = folder / place
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(_with_links(text, document, place, root, places), encoding="utf-8")
    for picture in (root / "docs").rglob("*.*"):
        if picture.suffix in {".png", ".svg", ".jpg", ".css"}:
            target = folder / picture.relative_to(root / "docs")
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(picture, target)


def with_parts(text: str, parts: Mapping[str, Callable[[], str]], document: Path) -> str:
    """The text with what its markers ask for."""

    def made(match: re.Match[str]) -> str:
        if match[1] not in parts:
            raise SiteInvalid(f"{document}: there is no part {match[1]!r}; known are {', '.join(sorted(parts))}")
        return parts[match[1]]()

    return MARKER.sub(made, text)


def _with_links(text: str, document: Path, place: Path, root: Path, places: Mapping[Path, Path]) -> str:
    """Links lead to pages and pictures of the site; of those to other files of the repository the words stay."""

    def moved(target: str) -> str | None:
        path, _, anchor = target.partition("#")
        if "://" in target or target.startswith("mailto:") or not path:
            return target
        wanted = Path(os.path.normpath(document.parent / path))
        if wanted in places:
            found = places[wanted]
        elif wanted.parts[0] == "docs" and (root / wanted).is_file():
            found = wanted.relative_to("docs")
        elif (root / wanted).exists():
            return None
        else:
            return target  # for the strict build to refuse
        return os.path.relpath(found, place.parent) + (f"#{anchor}" if anchor else "")

    def link(match: re.Match[str]) -> str:
        inner = _LINK.sub(link, match[2])  # a picture in a link
        target = moved(match[3])
        return inner if target is None else f"{match[1]}[{inner}]({target})"

    def source(match: re.Match[str]) -> str:
        return f"{match[1]}{moved(match[2]) or match[2]}{match[3]}"

    # Code in backticks within a link's words is part of the link: only fences and code outside of links are left alone.
    pieces = re.split(r"(^```.*?^```)", text, flags=re.MULTILINE | re.DOTALL)
    return "".join(
        piece if piece.startswith("```") else _SOURCE.sub(source, _LINK.sub(link, piece)) for piece in pieces
    )


def build(folder: Path = FOLDER) -> Path:
    """The site in `folder`/site, made of `folder`/pages.

    Raises SiteInvalid for a page that is in no section, CalledProcessError where a link leads nowhere.
    """
    pages, site = folder / "pages", folder / "site"
    for old in (pages, site):
        shutil.rmtree(old, ignore_errors=True)
    write_pages(ROOT, pages, PARTS)
    shutil.copyfile(Path(__file__).with_name("site.css"), pages / "site.css")
    configuration = CONFIGURATION.read_text(encoding="utf-8")
    if lost := [place for place in map(Path.as_posix, pages_of(ROOT).values()) if f'"{place}"' not in configuration]:
        raise SiteInvalid(f"{', '.join(sorted(lost))}: in no section of {CONFIGURATION.name}")
    (folder / CONFIGURATION.name).write_text(configuration, encoding="utf-8")
    subprocess.run([sys.executable, "-m", "zensical", "build", "--strict"], cwd=folder, check=True)
    if page.is_built():
        page.write_page(DEMO_FILE, site / DEMO)
    return site

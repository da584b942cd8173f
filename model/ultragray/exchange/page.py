"""A scene as a page: files that any web server hands out, in which a browser renders every frame itself.

The page and the renderer, libultragray in WebAssembly, are built by `make browser` from the folder `browser`.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from pathlib import Path

from ultragray.contract import to_dict
from ultragray.errors import BackendUnavailable, InvalidArgument
from ultragray.files import sync
from ultragray.rendering.display import true_to_scale
from ultragray.scene.info import SceneHeader, read_header

ASSETS = Path(__file__).with_name("page")
MAX_POSES = 240  # of the sweep: steps of its slider


def is_built() -> bool:
    """Whether `make browser` was run."""
    return (ASSETS / "ultragray.wasm").is_file()


def write_page(scene: Path, folder: Path) -> list[Path]:
    """Writes the page of a scene file into a folder that is not there, or empty: whole or not at all.

    Raises SceneFileInvalid, InvalidArgument for a scene that knows neither its probe nor its poses, and for a folder
    that holds something, BackendUnavailable where the page was not built, OSError.
    """
    header = read_header(scene)
    if header.info.probe is None or not len(header.training_poses):
        raise InvalidArgument("a page needs a scene that knows its probe and its training poses", field="scene")
    if not is_built():
        raise BackendUnavailable("the page is not built: run `make browser` in a checkout (needs Debian's emscripten)")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InvalidArgument(f"{folder} must be a new folder, or an empty one", field="page")
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        temporary.chmod(0o755)
        shutil.copytree(ASSETS, temporary, dirs_exist_ok=True, copy_function=shutil.copyfile)
        _write_compressed(header, scene, temporary / "scene.ugz")
        (temporary / "page.json").write_text(json.dumps(_described(header, scene.stem)), encoding="utf-8")
        for path in temporary.rglob("*"):
            sync(path)
        os.replace(temporary, folder)
        sync(folder.parent)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    return sorted(path for path in folder.rglob("*") if path.is_file())


def _write_compressed(header: SceneHeader, scene: Path, path: Path) -> None:
    if header.is_compressed:
        shutil.copyfile(scene, path)
        return
    from ultragray.scene.gaussians import GaussianScene  # and torch with it

    GaussianScene.load(scene).save(path)


def _described(header: SceneHeader, name: str) -> dict[str, object]:
    """Title, poses [P][16] and settings of the page."""
    info, poses = header.info, header.training_poses
    probe = info.probe_or(None)
    height, _ = info.image_size_or(None, None)
    step = -(-len(poses) // MAX_POSES)
    return {
        "title": info.dataset_name or name,
        "poses": poses[::step].reshape(-1, 16).tolist(),
        "settings": {"display": to_dict(true_to_scale(probe, height))},
        "labels": bool(info.label_names),
    }

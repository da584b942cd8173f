"""Edits of a scene file, and scene files made from labels, in a helper process. Free of torch until the work begins."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ultragray.contract import from_dict
from ultragray.files import file_sha256
from ultragray.scene.edits import edits_of
from ultragray.scene.recipes import SceneRecipe


def edit_scene_file(*, scenes: dict[str, str], output: str, edits: list[dict[str, Any]]) -> None:
    """Writes what edits make of scenes to `output`.

    `scenes`: files by name: the first is the one to edit, the others are those that edits name.
    Raises what `edit_scene` raises, and SceneFileInvalid.
    """
    from ultragray.learn.editing.editor import edit_scene
    from ultragray.scene.gaussians import GaussianScene

    scene, *_ = loaded = {name: GaussianScene.load(path) for name, path in scenes.items()}
    names = {name: file_sha256(path) for name, path in scenes.items()}
    edit_scene(loaded[scene], edits_of(edits), others=loaded, names=names).save(Path(output))


def make_scene_file(*, output: str, recipe: dict[str, Any]) -> None:
    """Writes the scene of a recipe to `output`. Raises what `scene_from_labels` raises."""
    from ultragray.learn.synthesis.scene import scene_from_labels

    scene_from_labels(from_dict(SceneRecipe, recipe)).save(Path(output))

"""Scene files made of others, in helper processes: edited, labelled, or made from labels. Free of torch until then."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np

from ultragray.contract import from_dict, under
from ultragray.files import file_sha256
from ultragray.geometry.probe import Probe
from ultragray.learn.localization.pixels import read_png
from ultragray.scene.edits import edits_of
from ultragray.scene.recipes import SceneRecipe
from ultragray_workers.errors import SceneExists


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


def label_scene(
    *,
    scene: str,
    output: str,
    replaced: str | None,
    names: dict[str, str],
    within_mm: float,
    frames: list[dict[str, Any]],
    probe: dict[str, Any] | None,
    label_map: str | None,
    map_to_scene: list[list[float]] | None,
) -> None:
    """Writes the scene file `scene` with other labels to `output`.

    `frames`: `pose` [4, 4] and `labels`, a PNG file in base64; or `label_map`, a NIfTI file, instead. `replaced` is the
    file that the output will take the place of: it may differ in its labels alone.
    Raises what `label_by_frames`, `label_by_map` and `read_label_map` raise, SceneFileInvalid, and SceneExists.
    """
    from ultragray.learn.labelling import PaintedFrame, label_by_frames, label_by_map, same_but_for_labels
    from ultragray.scene.gaussians import GaussianScene
    from ultragray.scene.label_maps import read_label_map

    loaded = GaussianScene.load(scene)
    if replaced is not None and not same_but_for_labels(loaded, GaussianScene.load(replaced)):
        raise SceneExists(
            "the scene to be replaced has other Gaussians: only the labels of a scene can be replaced", field="into"
        )
    known = {int(label): name for label, name in names.items()}
    if label_map is not None:
        volume, affine = read_label_map(label_map)
        new_scene = label_by_map(loaded, volume, affine, names=known, map_to_scene=map_to_scene, within_mm=within_mm)
    else:
        painted = []
        for index, frame in enumerate(frames):
            with under(f"frames[{index}]"):
                labels = read_png(base64.b64decode(frame["labels"]), "labels")
            painted.append(PaintedFrame(np.array(frame["pose"]), labels))
        chosen = None if probe is None else from_dict(Probe, probe)
        new_scene = label_by_frames(loaded, painted, names=known, probe=chosen, within_mm=within_mm)
    new_scene.save(Path(output))

"""edit_scene(): a list of edits, one after another, as a new scene that says what it was made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from hashlib import sha256
from typing import Any

import numpy as np

from ultragray.contract import under
from ultragray.errors import InvalidArgument
from ultragray.geometry.probe import FloatArray
from ultragray.learn.editing.insertion import draw_lesions, insert
from ultragray.learn.editing.merging import merge, registered
from ultragray.learn.editing.parts import moved_gaussians, part, rebuilt, stacked, with_label, within
from ultragray.learn.editing.thinning import thin
from ultragray.learn.labelling import labels_of, not_recorded, with_labels
from ultragray.learn.motion_fields import with_moved_modes
from ultragray.scene.edits import (
    CutEdit,
    Edit,
    InsertEdit,
    LesionsEdit,
    MergeEdit,
    MoveEdit,
    RelabelEdit,
    ThinEdit,
    check_edits,
    scenes_named,
)
from ultragray.scene.gaussians import GaussianScene

MODES = "modes of motion"  # as the file of a scene names what an edit left out
LOOKS_THE_SAME = ("relabel",)  # kinds whose frames are those of the parent: its metrics stay true


def edit_scene(
    scene: GaussianScene,
    edits: Sequence[Edit],
    *,
    others: Mapping[str, GaussianScene] | None = None,
    names: Mapping[str, str] | None = None,
) -> GaussianScene:
    """A new scene; the given ones stay as they are.

    `others`: the scenes that edits of the kind merge name. `names`: the names of the parents in the file of the result,
    with their SHA-256; what is left out is called `scene`, or as `others` has it, and is hashed.
    Raises InvalidArgument, naming the edit and its field.
    """
    check_edits(edits)
    scenes = {"scene": scene, **(others or {})}
    parents = dict(names or {}) or {name: digest(one) for name, one in scenes.items()}
    edited, recorded = scene, []
    for index, edit in enumerate(edits):
        is_moving = edited.moving is not None
        with under(f"edits[{index}]"):
            edited, done = _edited(edited, edit, others or {})
        is_moving |= any(scenes[name].moving is not None for name in scenes_named([edit]))
        if is_moving and edited.moving is None:
            done[-1]["left_out"] = [MODES]
        recorded += done
    provenance = {"parents": parents, "edits": recorded, "made": [*edited.info.made_labels]}
    same = all(edit.kind in LOOKS_THE_SAME for edit in edits)
    metrics = edited.info.metrics if same else {}
    return replace(edited, info=replace(edited.info, provenance=provenance, metrics=metrics))


def digest(scene: GaussianScene) -> str:
    """The SHA-256 that names a scene: that of its file, not compressed."""
    return sha256(scene.to_bytes()).hexdigest()


def _edited(
    scene: GaussianScene, edit: Edit, others: Mapping[str, GaussianScene]
) -> tuple[GaussianScene, list[dict[str, Any]]]:
    """The scene after an edit, and what its file tells of that: with all that the edit left open."""
    if isinstance(edit, LesionsEdit):
        drawn = draw_lesions(scene, edit)
        for one in drawn:
            scene = insert(scene, one)
        return scene, [one.recorded() for one in drawn]
    if isinstance(edit, MergeEdit):
        if edit.scene not in others:
            raise InvalidArgument(f"scene must be one of those given, got {edit.scene!r}", field="scene")
        scene, other = scene.at_rest(), others[edit.scene].at_rest()
        motion = edit.motion
        if edit.register:
            motion = registered(_still(scene), _still(other), motion)
        other = _moved(other, motion)
        merged = merge(_still(scene), _still(other), edit)
        if scene.moving is not None and other.moving is not None and scene.moving.is_same(other.moving):
            merged = replace(merged, moving=scene.moving, info=replace(merged.info, motion=scene.info.motion))
        return merged, [{**edit.recorded(), "motion": motion.tolist()}]
    done = _DONE.get(type(edit))
    if done is None:
        raise InvalidArgument(f"kind must be one of {', '.join(Edit.members)}, got {edit.kind}", field="kind")
    return done(scene, edit), [edit.recorded()]


def _cut(scene: GaussianScene, edit: CutEdit) -> GaussianScene:
    inside = within(scene, edit.shape)
    return part(scene, inside if edit.keep == "inside" else ~inside)


def _move(scene: GaussianScene, edit: MoveEdit) -> GaussianScene:
    if edit.shape is None:
        return _moved(scene, edit.motion)
    inside = within(scene, edit.shape)
    if not inside.any():
        raise InvalidArgument("shape must hold Gaussians of the scene, it holds none", field="shape")
    scene = with_labels(scene, labels_of(scene), scene.info.label_names, unrecorded=not_recorded(scene) | inside)
    there = part(scene, inside)
    there = rebuilt(there, moved_gaussians(there, edit.motion), there.labels)
    return there if inside.all() else stacked(scene, [part(scene, ~inside), there])


def _still(scene: GaussianScene) -> GaussianScene:
    """The scene without its modes of motion."""
    return replace(scene, moving=None, info=replace(scene.info, motion=None))


def _moved(scene: GaussianScene, motion: FloatArray) -> GaussianScene:  # [4, 4] mm
    """The scene with its poses and its modes of motion after a motion."""
    still = np.array_equal(motion, np.eye(4))
    if still:
        return scene
    moved = rebuilt(_still(scene), moved_gaussians(scene, motion), scene.labels)
    if scene.moving is not None:
        with suppress(InvalidArgument):  # no grid is fine enough for them and covers the turned scene
            moved = with_moved_modes(moved, scene.moving, motion)
    poses, corrections, rest = scene.training_poses, scene.pose_corrections, scene.rest_poses
    return replace(
        moved,
        training_poses=motion @ poses,
        pose_corrections=None if corrections is None else motion @ corrections @ np.linalg.inv(motion),
        rest_poses=None if rest is None else motion @ rest,
    )


def _relabel(scene: GaussianScene, edit: RelabelEdit) -> GaussianScene:
    chosen = np.zeros(len(scene.means), bool)
    for index, shape in enumerate(edit.shapes):
        with under(f"shapes[{index}]"):
            chosen |= within(scene, shape)
    if not chosen.any():
        raise InvalidArgument("shapes must hold Gaussians of the scene, they hold none", field="shapes")
    return with_label(scene, chosen, edit.label)


_DONE: dict[type[Edit], Callable[[GaussianScene, Any], GaussianScene]] = {
    MoveEdit: _move,
    CutEdit: _cut,
    InsertEdit: insert,
    RelabelEdit: _relabel,
    ThinEdit: thin,
}

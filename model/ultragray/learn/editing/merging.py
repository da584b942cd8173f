"""Two scenes become one: registered by what both show, made equally bright, joined along soft seams."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ultragray.contract import from_dict
from ultragray.errors import InvalidArgument
from ultragray.geometry.probe import BoolArray, FloatArray
from ultragray.learn.editing.parts import as_sigmoid, joined, means_mm, part, rebuilt, with_echo
from ultragray.learn.labelling import undirected_echo
from ultragray.learn.registration import register_frames
from ultragray.rendering.frames import render
from ultragray.scene.confidence import FAR_MM, SUPPORT_COVERAGE, TrainingViews, read_model
from ultragray.scene.edits import CutEdit, MergeEdit
from ultragray.scene.gaussians import GaussianScene

FRAMES, SIDE = 8, 128  # that both scenes show, for registration and gain; pixels of a side
FIT_SIDE, FIT_FRAMES = 128, 8  # pixels of a side; frames of a step
RATES = {"means": 1e-3, "scales": 1e-2, "quats": 1e-2, "transmittances": 2e-2, "sh0": 1e-2, "shN": 1e-4}
BETAS = (0.8, 0.95)
NOWHERE_MM = 1e6
_LEAST_PIXELS = 500  # that both support, for a gain
_CONTRASTS = (0.5, 2.0)
_LEAST_SHARE = 0.01  # of a scene at a place: it does not show there


def merge(scene: GaussianScene, other: GaussianScene, edit: MergeEdit) -> GaussianScene:
    """The scene with the Gaussians and training poses of another one, which already lies in its frame.

    At a place each has a share, by how near its training images are: with the interpolation distances i and j of the
    two (`ViewMeasures`), 1 / (1 + exp((i − j)/seam)). Frames are weighted means of all that lies at a place, weights
    and attenuation being volumes of Gaussians: so a Gaussian stays with twice the probability of its share, from a half
    on for certain, and its volume is scaled to what then makes up its share.
    """
    scene, other = as_sigmoid(scene), as_sigmoid(other)
    if edit.match_gain:
        other = _as_bright(other, scene)
    parts, is_shared = [], False
    for place, (one, beside) in enumerate(((scene, other), (other, scene))):
        points = means_mm(one)
        behind = (_distance_mm(one, points) - _distance_mm(beside, points)) / edit.seam_mm
        share = 1.0 / (1.0 + np.exp(np.clip(behind, -50.0, 50.0)))
        is_shared |= bool((share < 1.0 - _LEAST_SHARE).any())
        parts.append(_shared(one, share, seed=place))
    whole = joined(*parts)
    info = replace(
        whole.info,
        confidence=_confidence(scene, other),
        provenance={"made": list(whole.info.made_labels)},
        dataset_sha256=None,
    )
    poses = np.concatenate([scene.training_poses, other.training_poses])
    merged = replace(whole, info=info, training_poses=poses, pose_corrections=None)
    return _fitted(merged, (scene, other), edit.fit_steps) if is_shared else merged


def registered(scene: GaussianScene, other: GaussianScene, about: FloatArray) -> FloatArray:  # [4, 4] mm both
    """The motion that leads another scene into this one, from one that is about right.

    Frames of the other scene, rendered where this one has been seen, are looked for in this one.
    Raises InvalidArgument where they are not found, and where a scene knows no training poses.
    """
    poses = _common_poses(scene, other, about)
    if not len(poses):
        raise InvalidArgument("the scenes to be merged share no place that both have seen", field="register")
    frames = render(other, None, poses, height=SIDE, width=SIDE, outputs=("bmode",))["bmode"].cpu().numpy()
    registration = register_frames(scene, [*frames], poses, about, probe=other.info.probe)
    return registration.fit.base_to_scene


def _common_poses(scene: GaussianScene, other: GaussianScene, motion: FloatArray) -> FloatArray:  # [C, 4, 4] mm
    """Training poses of the other scene that are nearest to those of this one, in the other's frame."""
    views = _views(scene)
    probe, poses = other.info.probe, other.training_poses
    if views is None or probe is None or not len(poses):
        return np.zeros((0, 4, 4))
    away = views.measure(motion @ poses, probe).nearest_mm.mean(axis=1)
    nearest = np.sort(np.argsort(away)[: max(FRAMES, len(poses) // 4)])
    near: FloatArray = poses[nearest[np.linspace(0, len(nearest) - 1, min(FRAMES, len(nearest))).round().astype(int)]]
    return near


def _as_bright(other: GaussianScene, scene: GaussianScene) -> GaussianScene:
    """The other scene with such echo that its frames have mean and contrast of this one's, where both have support."""
    poses = _common_poses(scene, other, np.eye(4))
    if not len(poses):
        return other
    size: Any = {"height": SIDE, "width": SIDE, "outputs": ("echo", "coverage")}
    here, there = (render(one, other.info.probe, poses, **size) for one in (scene, other))
    both = (here["coverage"] > SUPPORT_COVERAGE) & (there["coverage"] > SUPPORT_COVERAGE)
    if int(both.sum()) < _LEAST_PIXELS:
        return other
    wanted, present = here["echo"][both], there["echo"][both]
    contrast = float(np.clip(float(wanted.std()) / max(float(present.std()), 1e-6), *_CONTRASTS))
    echo = torch.from_numpy(undirected_echo(other)).to(other.means)
    return with_echo(other, float(wanted.mean()) + contrast * (echo - float(present.mean())), contrast)


def _fitted(merged: GaussianScene, parents: tuple[GaussianScene, GaussianScene], steps: int) -> GaussianScene:
    """The merged scene after some steps of Adam towards frames of its parents, each from its own training poses.

    Gaussians that were trained apart add up to other weights than together: this mends it. Rates fall to a tenth.
    """
    seen = [(one, one.info.probe, pose) for one in parents if one.info.probe for pose in one.training_poses]
    if not seen or not steps:
        return merged
    height, width = (min(side, FIT_SIDE) for side in merged.info.image_size_or(None, None))
    splats: dict[str, Any] = {name: raw.detach().clone().requires_grad_() for name, raw in merged.splats.items()}
    optimizer = torch.optim.Adam([{"params": [splats[name]], "lr": rate} for name, rate in RATES.items()], betas=BETAS)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.1 ** (1.0 / steps))
    random = np.random.default_rng(0)
    with torch.enable_grad():
        for _ in range(steps):
            optimizer.zero_grad()
            current = GaussianScene(**splats, info=merged.info)
            for index in random.integers(len(seen), size=FIT_FRAMES).tolist():
                parent, probe, pose = seen[index]
                size: Any = {"height": height, "width": width, "outputs": ("bmode",)}
                with torch.no_grad():
                    wanted = render(parent, probe, pose, **size)["bmode"]
                bmode = render(current, probe, pose, **size)["bmode"]
                torch.autograd.backward((bmode - wanted).abs().mean() / FIT_FRAMES)
            optimizer.step()
            schedule.step()
    return rebuilt(merged, {name: raw.detach() for name, raw in splats.items()}, merged.labels)


def _views(scene: GaussianScene) -> TrainingViews | None:
    if scene.info.probe is None or not len(scene.training_poses):
        return None
    return TrainingViews(scene.training_poses, scene.info.probe)


def _distance_mm(scene: GaussianScene, points: FloatArray) -> FloatArray:  # [N, 3] mm -> [N]
    """The interpolation distance of points to the training images; NOWHERE_MM where what was there was cut off."""
    views = _views(scene)
    distances = np.full(len(points), FAR_MM) if views is None else views.interpolation_mm(points)
    return np.where(_is_kept(scene, points), distances, NOWHERE_MM)


def _is_kept(scene: GaussianScene, points: FloatArray) -> BoolArray:  # [N, 3] mm -> [N]
    """Whether the edits that made a scene left it what lies at points, as far as its file tells."""
    kept = np.ones(len(points), bool)
    for document in scene.info.provenance.get("edits", ()):
        if document["kind"] in ("move", "merge"):  # what was cut before lies elsewhere, or has been filled
            kept[:] = True
        elif document["kind"] == "cut" and document["shape"]["kind"] != "label" and "data" not in document["shape"]:
            edit = from_dict(CutEdit, document)
            kept &= (edit.shape.distance_mm(points) < 0.0) == (edit.keep == "inside")
    return kept


def _shared(scene: GaussianScene, share: FloatArray, seed: int) -> GaussianScene:  # [N]
    """The Gaussians of a scene that show where it has these shares. The draw is the same each time."""
    drawn = np.random.default_rng(seed).uniform(_LEAST_SHARE, 1.0, len(share))
    stays = np.minimum(1.0, 2.0 * share)
    kept = stays >= drawn
    if not kept.any():
        raise InvalidArgument("one of the scenes has nothing to add to the other: the other one saw all of it better")
    thinner = np.log(np.minimum(1.0, share / np.maximum(stays, 1e-9))) / 3.0
    scales = scene.scales + torch.from_numpy(thinner).to(scene.means)[:, None]
    return part(scene, kept, scales=scales[torch.from_numpy(kept)])


def _confidence(scene: GaussianScene, other: GaussianScene) -> dict[str, Any]:
    """The model of the first scene with the hardness of the training views of both; none where it has none."""
    mine, theirs = (read_model(one.info.confidence, len(one.training_poses)) for one in (scene, other))
    if mine is None:
        return {}
    mean = float(np.mean(mine.hardness)) if mine.hardness else 0.0
    added = theirs.hardness if theirs is not None else (mean,) * len(other.training_poses)
    return replace(mine, hardness=(*mine.hardness, *added)).to_dict()

"""Labels of a scene's Gaussians, from frames on which somebody painted, and from a label map in three dimensions.

A pixel p of a frame shows Gaussian g by the share w_g(p) / S(p) (docs/physics.md §3). A painted pixel gives that share
to its label as a vote of g; summed over the pixels of a label they are the adjoint of the output `labels`, which the
backends' backward pass gives: with one intensity for all Gaussians, Σ I·w has the derivative I'·w by their harmonics.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ultragray.errors import InvalidArgument
from ultragray.geometry.image_size import check_image_size
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import BoolArray, FloatArray, Probe
from ultragray.rendering.backends.inputs import beam_cm, scene_poses
from ultragray.rendering.backends.registry import BACKENDS, choose_backend
from ultragray.rendering.frames import render
from ultragray.rendering.outputs import INTENSITY_SUM, WEIGHT_SUM
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.info import MAX_LABEL, MAX_WITHIN_MM, UNPAINTED

CORRECTION = 4.0  # votes of a painted pixel that would come out otherwise by the frames before
LEAST_PAINTED = 0.25  # of what a Gaussian shows of itself in a frame: a brush beside it does not reach it
NEIGHBOURS = 12  # that a Gaussian takes its label from
SIMILAR_ECHO = 0.2  # difference of intensities, in [0, 1], from which on a neighbour does not count
_SH_C0 = 0.5 / math.sqrt(math.pi)  # the harmonic of degree 0
_LEAST_SUM = 1.0 / 255.0  # of weights: a pixel with less shows nothing

LabelArray = npt.NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class PaintedFrame:
    """What a person says of the pixels of a frame: rows along depth, columns across scan lines, not scan-converted."""

    pose: FloatArray  # [4, 4] mm, probe to scene
    labels: LabelArray  # [H, W]; 0: no label; UNPAINTED: nothing is said


def label_by_frames(
    scene: GaussianScene,
    frames: Sequence[PaintedFrame],
    *,
    names: Mapping[int, str],
    probe: Probe | None = None,
    within_mm: float = 0.0,
    backend: str = "auto",
) -> GaussianScene:
    """The scene with the labels that `frames`, in the order in which they were painted, give its Gaussians.

    Each Gaussian takes the label with most votes. Where a frame contradicts what those before it show, its pixels count
    CORRECTION times. Gaussians that no frame reaches keep the label that they have; those without one take that of
    labelled ones within `within_mm` that echo alike (0: none do). `names` are added to those of the scene. `probe` is
    that of the frames, None: the scene's own.
    Raises InvalidArgument for no frame, images that are no uint8 [H, W], painted labels without a name, and a distance
    beyond 0 to MAX_WITHIN_MM; InvalidPose, InvalidProbe, InvalidImageSize, BackendUnavailable.
    """
    within_mm = _checked_distance(within_mm)
    known = _checked_names(scene, names)
    if not frames:
        raise InvalidArgument("frames must be at least one", field="frames")
    for index, frame in enumerate(frames):
        _check_frame(frame, known, f"frames[{index}]")
    probe = scene.info.probe_or(probe)
    painted = np.unique(np.concatenate([frame.labels.ravel() for frame in frames]))
    painted = painted[painted != UNPAINTED]  # [L]
    votes = scene.means.new_zeros((len(scene.means), len(painted)))  # [N, L]
    labelled = scene
    for frame in frames:
        weights = np.ones(frame.labels.shape, np.float32)
        if labelled.labels is not None:
            current = _shown_labels(labelled, probe, frame, backend)
            weights[current != frame.labels] = CORRECTION
        _add_votes(votes, painted, scene, probe, frame, weights, backend)
        labels, voted = _decided(votes, painted, scene)
        # The next frame is held against what these say.
        labelled = with_labels(scene, labels, known, unrecorded=np.zeros(len(labels), bool))
    return with_labels(scene, _spread(scene, labels, voted, within_mm), known)


def label_by_map(
    scene: GaussianScene,
    volume: npt.NDArray[np.integer[Any]],  # [I, J, K]
    affine: Any,  # [4, 4] voxels to mm of the map's frame
    *,
    names: Mapping[int, str],
    map_to_scene: Any = None,  # [4, 4] mm, rigid; None: the map lies in the scene's frame
    within_mm: float = 0.0,
) -> GaussianScene:
    """The scene with the labels of a map at the middle of each Gaussian; outside the map Gaussians keep theirs.

    0 is no label. Labels without a name are called after their number. `within_mm`: as `label_by_frames` has it.
    Raises InvalidArgument for a map that is no volume of whole numbers from 0 to 255, an affine that cannot be
    inverted, a map that no Gaussian lies in; InvalidPose.
    """
    within_mm = _checked_distance(within_mm)
    known = _checked_names(scene, names)
    if volume.ndim != 3 or volume.dtype.kind not in "iu" or not volume.size:
        raise InvalidArgument(
            f"volume must be whole numbers [I, J, K], got {volume.dtype} {list(volume.shape)}", field="label_map"
        )
    low, high = int(volume.min()), int(volume.max())
    if low < 0 or high > MAX_LABEL:
        raise InvalidArgument(f"labels must be from 0 to {MAX_LABEL}, the map has {low} to {high}", field="label_map")
    to_mm = _checked_affine(affine)
    if map_to_scene is not None:
        to_mm = check_poses(map_to_scene, field="map_to_scene")[0] @ to_mm
    to_voxels = np.linalg.inv(to_mm)
    means_mm = np.asarray(scene.info.centre_mm) + 10.0 * scene.means.detach().cpu().double().numpy()
    places = np.rint(means_mm @ to_voxels[:3, :3].T + to_voxels[:3, 3])  # [N, 3]
    inside = ((places >= 0) & (places < volume.shape)).all(axis=1)
    if not inside.any():
        raise InvalidArgument(
            "no Gaussian of the scene lies in the label map: is it registered to the frame of the scene, in mm?",
            field="label_map",
        )
    labels = labels_of(scene)
    labels[inside] = volume[tuple(places[inside].astype(np.int64).T)]
    known |= {label: f"label {label}" for label in np.unique(labels).tolist() if label and label not in known}
    return with_labels(scene, _spread(scene, labels, inside, within_mm), known)


def same_but_for_labels(one: GaussianScene, other: GaussianScene) -> bool:
    """Whether two scenes have the same Gaussians and training poses, whatever their labels."""
    if any(not torch.equal(raw, other.splats[name]) for name, raw in one.splats.items()):
        return False
    return np.array_equal(one.training_poses, other.training_poses) and one.info.centre_mm == other.info.centre_mm


def _check_frame(frame: PaintedFrame, names: Mapping[int, str], field: str) -> None:
    labels = frame.labels
    if labels.ndim != 2 or labels.dtype != np.uint8:
        raise InvalidArgument(
            f"{field}.labels must be uint8 [H, W], got {labels.dtype} {list(labels.shape)}", field=f"{field}.labels"
        )
    check_image_size(*labels.shape)
    if unnamed := set(np.unique(labels).tolist()) - {0, UNPAINTED, *names}:
        raise InvalidArgument(
            f"{field}.labels has {min(unnamed)}, which label_names does not name; {UNPAINTED} is not painted, 0 is no "
            "label",
            field="label_names",
        )
    if not (labels != UNPAINTED).any():
        raise InvalidArgument(f"{field}.labels has no painted pixel: all are {UNPAINTED}", field=f"{field}.labels")


def _checked_names(scene: GaussianScene, names: Mapping[int, str]) -> dict[int, str]:
    known = replace(scene.info, label_names={**scene.info.label_names, **names}).label_names
    if UNPAINTED in known:
        raise InvalidArgument(
            f"label_names may name 1 to {UNPAINTED - 1}: {UNPAINTED} is not painted", field="label_names"
        )
    return known


def _checked_distance(within_mm: float) -> float:
    if not 0.0 <= within_mm <= MAX_WITHIN_MM:
        raise InvalidArgument(f"within_mm must be from 0 to {MAX_WITHIN_MM:g}, got {within_mm}", field="within_mm")
    return float(within_mm)


def _checked_affine(affine: Any) -> FloatArray:  # [4, 4]
    matrix = np.asarray(affine, np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or abs(np.linalg.det(matrix[:3, :3])) < 1e-12:
        raise InvalidArgument("affine must be [4, 4] and lead voxels to places in mm", field="label_map")
    return matrix


def _shown_labels(scene: GaussianScene, probe: Probe, frame: PaintedFrame, backend: str) -> LabelArray:  # [H, W]
    height, width = frame.labels.shape
    frames = render(scene, probe, frame.pose, height=height, width=width, outputs=("labels",), backend=backend)
    labels: LabelArray = frames["labels"][0].cpu().numpy()
    return labels


def _add_votes(
    votes: Tensor,  # [N, L], changed
    painted: LabelArray,  # [L]
    scene: GaussianScene,
    probe: Probe,
    frame: PaintedFrame,
    weights: npt.NDArray[np.float32],  # [H, W] votes of each pixel
    backend: str,
) -> None:
    """Votes of the painted pixels of a frame, for the Gaussians of which enough is painted."""
    like = scene.means
    with torch.enable_grad():
        harmonics = torch.zeros_like(scene.sh0).requires_grad_()  # intensity ½, of derivative _SH_C0
        splats: dict[str, Any] = {name: raw.detach() for name, raw in scene.splats.items()}
        splats |= {"sh0": harmonics, "shN": harmonics.detach()[:, :0]}
        info = replace(scene.info, sh_degree=0, intensity="sigmoid", label_names={})
        grey = GaussianScene(**splats, info=info)
        poses = scene_poses(scene, frame.pose)
        draw = BACKENDS[choose_backend(backend, scene)].draw
        planes = draw(
            grey, probe, poses, *frame.labels.shape, (WEIGHT_SUM, INTENSITY_SUM), beam=beam_cm(scene.info.beam, probe)
        )
        sums = planes[WEIGHT_SUM][0].detach()  # [H, W]
        shares = torch.where(sums >= _LEAST_SUM, 1.0 / sums.clamp(min=_LEAST_SUM), 0.0) / _SH_C0

        def to_gaussians(pixels: Tensor) -> Tensor:  # [H, W] -> [N]
            (by_harmonics,) = torch.autograd.grad(
                planes[INTENSITY_SUM], harmonics, (pixels * shares)[None], retain_graph=True
            )
            return by_harmonics.flatten()

        labels, worth = torch.from_numpy(frame.labels).to(like.device), torch.from_numpy(weights).to(like)
        areas = to_gaussians(torch.ones_like(sums))  # of each Gaussian, in pixels
        reached = (areas > 0.0) & (to_gaussians((labels != UNPAINTED).to(like)) >= LEAST_PAINTED * areas)
        for place in np.flatnonzero(np.isin(painted, frame.labels)).tolist():
            of_label = (labels == int(painted[place])) * worth
            votes[:, place] += torch.where(reached, to_gaussians(of_label), 0.0)


def _decided(
    votes: Tensor,  # [N, L]
    painted: LabelArray,  # [L]
    scene: GaussianScene,
) -> tuple[LabelArray, BoolArray]:  # [N] both
    """The label of each Gaussian, that of most votes or the one before, and whether it has votes."""
    most, place = votes.max(dim=1)
    voted = (most > 0.0).cpu().numpy()
    return np.where(voted, painted[place.cpu().numpy()], labels_of(scene)), voted


def _spread(
    scene: GaussianScene,
    labels: LabelArray,  # [N]
    voted: BoolArray,  # [N] whose labels are new
    within_mm: float,
) -> LabelArray:  # [N]
    """Labels for Gaussians without: of the nearest that have one, or votes; nearer ones count more, up to within_mm.

    It is new labels that spread: where the winner among the neighbours is of old ones alone, nothing changes.
    """
    decided = voted | (labels > 0)
    if within_mm == 0.0 or decided.all() or not voted.any():
        return labels
    means_mm = 10.0 * scene.means.detach().cpu().float().numpy()
    echo = undirected_echo(scene)
    sources, sought = np.flatnonzero(decided), np.flatnonzero(~decided)
    exact = {"algorithm": 4, "leaf_max_size": 16}  # one k-d tree: its answers are exact, and the same each time
    index = cv2.flann.Index(means_mm[sources], exact)  # type: ignore[arg-type]
    count = min(NEIGHBOURS, len(sources))
    indices, squared = index.knnSearch(means_mm[sought], count, params={"checks": -1})
    near = sources[indices]  # [M, count]
    weights = np.clip(1.0 - squared / within_mm**2, 0.0, None)
    weights[np.abs(echo[near] - echo[sought][:, None]) > SIMILAR_ECHO] = 0.0
    there, places = np.unique(labels[sources], return_inverse=True)  # [L], of each source
    votes = np.zeros((len(sought), len(there)), np.float32)
    np.add.at(votes, (np.arange(len(sought))[:, None], places[indices]), weights)
    winner = votes.argmax(axis=1)  # [M]
    is_new = ((weights > 0.0) & voted[near] & (places[indices] == winner[:, None])).any(axis=1)
    spread = labels.copy()
    spread[sought] = np.where(is_new, there[winner], labels[sought])
    return spread


def undirected_echo(scene: GaussianScene) -> npt.NDArray[np.float32]:  # [N] in [0, 1]
    """Intensities seen from no direction."""
    value = _SH_C0 * scene.sh0.detach().cpu().float().flatten()
    activated = torch.sigmoid(4.0 * value) if scene.info.intensity == "sigmoid" else (value + 1.0).clamp(0.5, 0.999)
    return activated.numpy()


def labels_of(scene: GaussianScene) -> LabelArray:  # [N], 0: none
    if scene.labels is None:
        return np.zeros(len(scene.means), np.uint8)
    labels: LabelArray = scene.labels.cpu().numpy().copy()
    return labels


def not_recorded(scene: GaussianScene) -> BoolArray:  # [N]
    """The Gaussians that stand for nothing that was recorded."""
    unrecorded: BoolArray = np.isin(labels_of(scene), scene.info.made_labels)
    return unrecorded


def with_labels(
    scene: GaussianScene,
    labels: LabelArray,  # [N]
    names: Mapping[int, str],
    unrecorded: BoolArray | None = None,  # [N]
) -> GaussianScene:
    """The same scene with other labels; with none at all where no label has a name.

    `unrecorded`: the Gaussians that nobody recorded; None: those of the scene. Their labels alone tell them from the
    others: where recorded ones have the same label, or there is none, they get one of their own, NAME (not recorded).
    Raises InvalidArgument where no number is free for that.
    """
    unrecorded = not_recorded(scene) if unrecorded is None else unrecorded
    labels, names = labels.copy(), dict(names)
    for label in np.unique(labels[unrecorded]).tolist():
        own, name = unrecorded & (labels == label), names.get(label, "")
        while not label or (labels[~unrecorded] == label).any():
            name = f"{name} (not recorded)" if name else "not recorded"
            label = label_number(names, name)
            names[label] = name
        labels[own] = label
    if not names:
        return replace(scene, labels=None, info=replace(scene.info, label_names={}))
    provenance = scene.info.provenance
    of_unrecorded = {*provenance.get("made", ()), *labels[unrecorded].tolist()} - {*labels[~unrecorded].tolist()}
    if of_unrecorded or "made" in provenance:
        provenance = {**provenance, "made": sorted(of_unrecorded)}
    on_device = torch.from_numpy(labels).to(scene.means.device)
    return replace(scene, labels=on_device, info=replace(scene.info, label_names=names, provenance=provenance))


def label_number(names: dict[int, str], name: str) -> int:
    """The number of a label, its own or a free one. Raises InvalidArgument where none is free."""
    known = next((label for label, one in names.items() if one == name), None)
    free = next((label for label in range(1, MAX_LABEL + 1) if label not in names and label != UNPAINTED), None)
    if known is None and free is None:
        raise InvalidArgument(f"the scene has all labels that there can be: none is free for {name!r}", field="label")
    return known or free or 0

"""`Drawing`, the planes of some views, and outputs that follow from more than one plane at a pixel: labels, and the
expected error of B-mode. `ultragray.rendering.outputs` says what they are and which planes they take.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ultragray.geometry.probe import BoolArray, FloatArray, Probe
from ultragray.rendering.backends.inputs import ScenePoses, as_array
from ultragray.rendering.limits import Limits
from ultragray.rendering.overlays import GHOST_PLANES, ToolsInView, add_ghosts
from ultragray.rendering.speckle import with_speckle
from ultragray.scene.confidence import DepthBands, TrainingViews, read_model
from ultragray.scene.gaussians import GaussianScene

MIN_WEIGHT_SUM = 1.0 / 255.0  # a label with less is not seen
View = tuple[Probe, ScenePoses, int, int]  # poses [C, 4, 4] in cm about the scene's centre; height and width
ENDED_BY_AIR = ("bmode", "transmittance")  # planes that are 0 along a scan line without contact: no beam gets out


class Drawing:
    """Views of a scene by one backend: the planes that outputs are derived from."""

    def __init__(
        self,
        draw: Callable[..., dict[str, Tensor]],
        scene: GaussianScene,
        view: View,
        limits: Limits,
        beam: Tensor | None,
        touching: BoolArray | None = None,
        tools: ToolsInView | None = None,
        ghost: float = 0.0,
        speckle_by: str | None = None,
    ) -> None:
        """`beam`: [3] in cm; `touching`: [C, W], whether scan lines have contact, None: all have; `speckle_by`: the
        backend that puts speckle into B-mode, None: there is none.
        """
        self.scene = scene
        self.shape = (len(view[1]), view[2], view[3])
        self._draw, self._view, self._limits, self._beam = draw, view, limits, beam
        self._touching, self._tools, self._ghost = touching, tools, ghost
        self._speckle_by = speckle_by
        self._planes: dict[str, Tensor] = {}

    @property
    def probe(self) -> Probe:
        return self._view[0]

    @property
    def poses_mm(self) -> FloatArray:
        """[C, 4, 4] mm, in the tissue at rest."""
        return in_mm(self.scene, self._view[1])

    def draw(self, planes: Sequence[str]) -> None:
        """Draws planes of the whole scene at once."""
        if planes:
            drawn = self._draw(self.scene, *self._view, self._needed(planes), self._limits, self._beam)
            self._planes = dict(drawn)
        if self._tools is not None:
            self._tools.draw(self._planes, self.shape[1], self.scene.means)
        if self._touching is not None and not self._touching.all():
            for name in set(ENDED_BY_AIR) & set(self._planes):
                self._planes[name] = self._heard(self._planes[name])
        if self._ghost and "bmode" in self._planes:
            add_ghosts(self._planes, self.probe, self._ghost)

    def _needed(self, planes: Sequence[str]) -> Sequence[str]:
        """The planes to draw for these: those with them that tools and ghosts follow from."""
        if self._ghost and set(GHOST_PLANES) & set(planes):
            return tuple(dict.fromkeys((*planes, *GHOST_PLANES)))
        if self._tools is not None and "bmode" in planes:
            return tuple(dict.fromkeys((*planes, "transmittance")))
        return planes

    def _heard(self, plane: Tensor) -> Tensor:  # [C, H, W] -> [C, H, W]
        """A plane that is 0 along scan lines without contact."""
        return plane if self._touching is None else plane * torch.from_numpy(self._touching).to(plane)[:, None]

    def plane(self, name: str) -> Tensor:  # [C, H, W]
        return self._planes[name]

    def bmode(self) -> Tensor:  # [C, H, W]
        """B-mode with its speckle, which what follows from the plane does not have."""
        plane = self._planes["bmode"]
        if self._speckle_by is None:
            return plane
        return self._heard(with_speckle(self.scene, plane, self.probe, self.poses_mm, backend=self._speckle_by))

    def plane_of(self, part: GaussianScene, name: str) -> Tensor:  # [C, H, W]
        """A plane of some of the scene's Gaussians alone."""
        return self._draw(part.under(*self.scene.displacements), *self._view, (name,), self._limits, self._beam)[name]

    def mark_tools(self, labels: Tensor) -> None:
        """Puts the labels of tools into labels [C, H, W], where they are."""
        if self._tools is not None:
            self._tools.mark(labels)


def in_mm(scene: GaussianScene, poses: ScenePoses) -> FloatArray:  # [C, 4, 4] cm -> [C, 4, 4] mm
    """Poses of the scene's frame in the tissue at rest."""
    moved = as_array(poses).copy()
    moved[:, :3, 3] = 10.0 * moved[:, :3, 3] + np.asarray(scene.info.centre_mm)
    return moved


def render_labels(drawing: Drawing, weight_sum: str) -> Tensor:  # [C, H, W] uint8
    """argmax over l of S_l, the plane `weight_sum` of the Gaussians of label l; 0 where no S_l reaches 1/255.

    Gaussians without a label are those of label 0. Of labels that weigh the same, the smallest is taken. Tools are over
    all.
    """
    scene = drawing.scene
    with torch.no_grad():
        parts = scene.prepared("labels", lambda: label_parts(scene))
        weights = ((label, drawing.plane_of(part, weight_sum)) for label, part in parts)
        labels = heaviest_labels(weights, scene.means.new_zeros(drawing.shape))
    drawing.mark_tools(labels)
    return labels


def heaviest_labels(weights: Iterable[tuple[int, Tensor]], heaviest: Tensor) -> Tensor:  # [C, H, W] each
    """The label of the largest weight at each pixel, uint8; 0 where none reaches 1/255. `heaviest`: zeros, changed."""
    labels = torch.zeros(heaviest.shape, dtype=torch.uint8, device=heaviest.device)
    for label, weight in weights:
        _keep_heavier(labels, heaviest, label, weight)
    return labels


def _keep_heavier(labels: Tensor, heaviest: Tensor, label: int, weight: Tensor) -> None:  # [C, H, W] each
    """Puts a label where it weighs more than those before it, and what it weighs there."""
    if labels.is_cuda:
        heavier = (weight > heaviest) & (weight >= MIN_WEIGHT_SUM)
        labels.masked_fill_(heavier, label)
        heaviest.copy_(torch.where(heavier, weight, heaviest))
    else:  # by numpy: on a busy machine the threads of torch wait for each other longer than a frame takes
        most, own = heaviest.numpy(), weight.numpy()
        more = (own > most) & (own >= MIN_WEIGHT_SUM)
        np.copyto(labels.numpy(), np.uint8(label), where=more)
        np.copyto(most, own, where=more)


def label_parts(scene: GaussianScene) -> list[tuple[int, GaussianScene]]:
    """The Gaussians of each label that occurs, as scenes of their own; their intensities do not matter."""
    if scene.labels is None:
        return []
    parts = []
    for label in torch.unique(scene.labels).tolist():
        chosen = scene.labels == label
        splats: dict[str, Any] = {name: raw.detach()[chosen] for name, raw in scene.splats.items() if name != "shN"}
        splats["shN"] = splats["sh0"][:, :0]
        info = replace(scene.info, sh_degree=0, gaussian_count=len(splats["means"]), label_names={})
        parts.append((label, GaussianScene(**splats, info=info)))
    return parts


def recorded_part(scene: GaussianScene) -> GaussianScene | None:
    """The Gaussians of a scene that stand for what was recorded; None where there are none."""
    labels = scene.labels
    if not scene.info.made_labels or labels is None:
        return scene

    def chosen() -> GaussianScene | None:
        kept = ~torch.isin(labels, labels.new_tensor(scene.info.made_labels))
        splats: dict[str, Any] = {name: raw.detach()[kept] for name, raw in scene.splats.items()}
        info = replace(scene.info, gaussian_count=int(kept.sum()), label_names={})
        return replace(scene.under(), **splats, labels=None, info=info) if kept.any() else None

    part = scene.prepared("recorded", chosen)
    return None if part is None else part.under(*scene.displacements)


# The expected standard deviation of a pixel's error, from the planes rendered around it and the distances of views.
#
# All terms are computed in CELLS² cells of the image, over which B̄, γ and T are means, and then interpolated. i and
# d are `interpolation_mm` and `distance_mm` of `ViewMeasures`, on a grid of POINTS_PER_SIDE² points, interpolated
# too, and reach(x, r) = 1 − exp(−x/r). The terms vₖ:
#
#     floor      0.001                 level      B̄/10           level²   B̄²       texture   mean of B² less B̄²
#     gap r      reach(i, r)·V         beyond     reach(d, 5 mm)·V
#     thin       (1 − γ)·V             shadow     (1 − T)·B̄/10

CELLS = 32  # a side; no more than pixels
POINTS_PER_SIDE = 12
GAPS_MM = (0.3, 1.0, 3.0)
BEYOND_MM = 5.0


def deviations(drawing: Drawing, names: Sequence[str]) -> Tensor:  # [C, H, W]
    """The output `uncertainty` of a scene that has its model, from the planes bmode, coverage and transmittance."""
    scene = drawing.scene
    planes = {name: drawing.plane(name) for name in names}
    if (recorded := recorded_part(scene)) is not scene:
        coverage = planes["coverage"]
        planes["coverage"] = torch.zeros_like(coverage) if recorded is None else drawing.plane_of(recorded, "coverage")
    model = read_model(scene.info.confidence, len(scene.training_poses))
    assert model is not None
    assert model.uncertainty is not None
    views = TrainingViews(scene.at_rest().training_poses, scene.info.probe_or(None))
    drawn = planes["bmode"], planes["coverage"], planes["transmittance"]
    distances_mm = view_distances(views, drawing.poses_mm, drawing.probe)
    terms = variance_terms(drawn, distances_mm, model.uncertainty.bands)
    weighted = [weight * term for weight, term in zip(model.uncertainty.variances, terms, strict=True)]
    deviation = torch.stack(weighted).sum(dim=0).clamp(0.0, 1.0).sqrt()
    return _interpolated(deviation, drawing.shape[1:])


def view_distances(
    views: TrainingViews, poses: FloatArray, probe: Probe
) -> tuple[FloatArray, FloatArray]:  # [C, 4, 4] mm -> two of [C, POINTS_PER_SIDE, POINTS_PER_SIDE]
    """Interpolation distance and distance to the views, mm, on a grid over each image."""
    measures = views.measure(poses, probe, POINTS_PER_SIDE)
    grid = (len(poses), POINTS_PER_SIDE, POINTS_PER_SIDE)
    return measures.interpolation_mm.reshape(grid), measures.distance_mm.reshape(grid)


def variance_terms(
    planes: tuple[Tensor, ...],  # bmode, coverage, transmittance, each [C, H, W]
    distances_mm: tuple[FloatArray, FloatArray],  # of `view_distances`
    bands: DepthBands,  # of the training images
) -> Iterator[Tensor]:  # each [C, h, w]
    """The vₖ in each cell, in the order of `uncertainty.TERMS`."""
    mean, coverage, transmittance = map(in_cells, planes)
    cells = mean.shape[1:]
    interpolation, distance = (
        _interpolated(torch.as_tensor(values, dtype=mean.dtype, device=mean.device), cells) for values in distances_mm
    )
    level, spread = (
        _interpolated(torch.tensor(values, dtype=mean.dtype, device=mean.device)[None, :, None], (cells[0], 1))
        for values in (bands.level, bands.spread)
    )
    unknown = spread + (level - mean).square()
    yield torch.full_like(mean, 1e-3)
    yield 0.1 * mean
    yield mean.square()
    yield (in_cells(planes[0].square()) - mean.square()).clamp_min(0.0)
    for reach in GAPS_MM:
        yield -torch.expm1(-interpolation / reach) * unknown
    yield -torch.expm1(-distance / BEYOND_MM) * unknown
    yield (1.0 - coverage) * unknown
    yield 0.1 * (1.0 - transmittance) * mean


def in_cells(frames: Tensor) -> Tensor:  # [C, H, W] -> [C, h, w]
    height, width = frames.shape[1:]
    return functional.adaptive_avg_pool2d(frames, (min(CELLS, height), min(CELLS, width)))


def _interpolated(maps: Tensor, size: Sequence[int]) -> Tensor:  # [C, h, w] -> [C, *size]
    return functional.interpolate(maps[:, None], tuple(size), mode="bilinear", align_corners=False)[:, 0]

"""Parts of scenes and the Gaussians in them: choosing, joining, moving, splitting, and clipping at a surface."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ultragray.errors import InvalidArgument
from ultragray.geometry.probe import BoolArray, FloatArray
from ultragray.geometry.rotations import turns_of
from ultragray.learn.labelling import label_number, labels_of, not_recorded, undirected_echo, with_labels
from ultragray.learn.sweep import IntArray
from ultragray.rendering.backends.reference import inverse_root_covariance, spherical_harmonics
from ultragray.scene.gaussians import PARAMETERS, GaussianScene
from ultragray.scene.shapes import LabelShape, Shape

Distance = Callable[[FloatArray], FloatArray]  # [N, 3] mm -> [N] mm, negative inside

SH_C0 = 0.5 / math.sqrt(math.pi)  # the harmonic of degree 0
_DARKEST, _BRIGHTEST = 1e-3, 0.999  # of a sigmoid intensity
_REACH = 2.5  # standard deviations: what is farther from a surface is not changed by it
_SHOWN = 2.0  # likewise: a body outweighs what shows less of a Gaussian. With 2.5 `make editing` finds a seam
_LEAST_SHARE = 0.05  # of a Gaussian on one side of a surface: less is left out
_PAIRS = 1 << 21  # of a Gaussian and a point, at once
_THINNER = 0.25  # a half would keep Σ w on average; but coverage is concave in it. Found by `make editing`
_STEP_MM = 0.05  # of the differences that give normals
_HALF_MEAN, _HALF_DEVIATION = math.sqrt(2.0 / math.pi), math.sqrt(1.0 - 2.0 / math.pi)  # of one half of a Gaussian


def means_mm(scene: GaussianScene) -> FloatArray:  # [N, 3]
    means: FloatArray = np.asarray(scene.info.centre_mm) + 10.0 * scene.means.detach().cpu().double().numpy()
    return means


def within(scene: GaussianScene, shape: Shape) -> BoolArray:  # [N]
    """The Gaussians whose middle lies in a shape. Raises InvalidArgument for a label that the scene does not have."""
    if not isinstance(shape, LabelShape):
        inside: BoolArray = shape.distance_mm(means_mm(scene)) < 0.0
        return inside
    number = next((label for label, name in scene.info.label_names.items() if name == shape.name), None)
    if number is None or scene.labels is None:
        known = ", ".join(scene.info.label_names.values()) or "none"
        raise InvalidArgument(f"name must be a label of the scene ({known}), got {shape.name!r}", field="shape.name")
    named: BoolArray = scene.labels.cpu().numpy() == number
    return named


def part(scene: GaussianScene, chosen: BoolArray | IntArray | Tensor, **others: Tensor) -> GaussianScene:
    """Some Gaussians of a scene, by a mask or by indices; `others`: their values in place of the scene's.

    Raises InvalidArgument where none is left.
    """
    index = torch.as_tensor(chosen, device=scene.means.device)
    splats = {name: others.get(name, raw.detach()[index]) for name, raw in scene.splats.items()}
    if not len(splats["means"]):
        raise InvalidArgument("the edit leaves no Gaussian of the scene", field="edits")
    labels = None if scene.labels is None else others.get("labels", scene.labels[index])
    return rebuilt(scene, splats, labels)


def rebuilt(scene: GaussianScene, splats: dict[str, Tensor], labels: Tensor | None, **info: Any) -> GaussianScene:
    """The scene with other Gaussians, and other facts of `info`."""
    return GaussianScene.from_splats(
        splats,
        info=replace(scene.info, **info),
        training_poses=scene.training_poses,
        labels=labels,
        pose_corrections=scene.pose_corrections,
        rest_poses=scene.rest_poses,
        moving=scene.moving,
    )


def joined(scene: GaussianScene, other: GaussianScene) -> GaussianScene:
    """The Gaussians of both, in the frame and with the facts of the first; labels of one name become one.

    Both have `sigmoid` intensities.
    """
    like = scene.means
    degree = max(scene.shN.shape[1], other.shN.shape[1])
    shift = (np.asarray(other.info.centre_mm) - np.asarray(scene.info.centre_mm)) / 10.0
    theirs = {**{name: raw.detach().to(like) for name, raw in other.splats.items()}}
    theirs["means"] = theirs["means"] + torch.from_numpy(shift).to(like)
    splats = {}
    for name, raw in scene.splats.items():
        both = [raw.detach(), theirs[name]]
        if name == "shN":
            both = [torch.cat([one, one.new_zeros(len(one), degree - one.shape[1], 1)], dim=1) for one in both]
        splats[name] = torch.cat(both)
    names = dict(scene.info.label_names)
    table = np.zeros(256, np.uint8)
    for label, name in other.info.label_names.items():
        table[label] = number = label_number(names, name)
        names[number] = name
    labels = np.concatenate([labels_of(scene), table[labels_of(other)]])
    unrecorded = np.concatenate([not_recorded(scene), not_recorded(other)])
    return with_labels(rebuilt(scene, splats, None, label_names={}), labels, names, unrecorded)


def with_label(scene: GaussianScene, chosen: BoolArray, name: str | None) -> GaussianScene:
    """The scene in which some Gaussians have a label, or lose theirs."""
    names = dict(scene.info.label_names)
    number = 0 if name is None else label_number(names, name)
    names |= {} if name is None else {number: name}
    labels = labels_of(scene)
    labels[chosen] = number
    return with_labels(scene, labels, names)


def as_sigmoid(scene: GaussianScene) -> GaussianScene:
    """The scene with intensities without a floor: what is darker than 0.5 can be inserted.

    Exact from no direction, and to first order in what intensities change with it.
    """
    if scene.info.intensity == "sigmoid":
        return scene
    echo = torch.from_numpy(undirected_echo(scene)).to(scene.means)
    sh0, slope = harmonics_of(echo)
    shn = scene.shN * torch.where((echo > 0.5) & (echo < _BRIGHTEST), slope, 0.0)[:, None, None]
    return rebuilt(scene, {**scene.splats, "sh0": sh0, "shN": shn}, scene.labels, intensity="sigmoid")


def harmonics_of(echo: Tensor) -> tuple[Tensor, Tensor]:  # [N] -> [N, 1, 1], [N]
    """`sh0` by which a sigmoid scene has these intensities, and how steeply it rises with them."""
    clamped = echo.clamp(_DARKEST, _BRIGHTEST)
    return (torch.logit(clamped) / (4.0 * SH_C0)).reshape(-1, 1, 1), 0.25 / (clamped * (1.0 - clamped))


def with_echo(scene: GaussianScene, echo: Tensor, contrast: float = 1.0) -> GaussianScene:  # [N]
    """The scene, a sigmoid one, with other intensities; what they change by direction is scaled by `contrast`."""
    before = torch.from_numpy(undirected_echo(scene)).to(scene.means)
    (_, flat), (sh0, slope) = harmonics_of(before), harmonics_of(echo)
    shn = scene.shN * (contrast * slope / flat)[:, None, None]
    return rebuilt(scene, {**scene.splats, "sh0": sh0, "shN": shn}, scene.labels)


def moved_gaussians(scene: GaussianScene, motion: FloatArray) -> dict[str, Tensor]:  # [4, 4] mm
    """The Gaussians after a rigid motion, about the same centre. Harmonics turn as functions on the sphere do."""
    like = scene.means
    centre = np.asarray(scene.info.centre_mm)
    shift = (motion[:3, :3] @ centre + motion[:3, 3] - centre) / 10.0
    rotation = torch.from_numpy(motion[:3, :3]).to(like)
    axis_angle = turns_of(motion[None, :3, :3])[0]
    angle = float(np.linalg.norm(axis_angle))
    sine = math.sin(angle / 2.0) / angle if angle > 0.0 else 0.5
    turn = like.new_tensor([math.cos(angle / 2.0), *(sine * axis_angle)])
    splats = {name: raw.detach() for name, raw in scene.splats.items()}
    splats["means"] = splats["means"] @ rotation.T + torch.from_numpy(shift).to(like)
    splats["quats"] = _product(turn, splats["quats"])
    splats["shN"] = torch.einsum("kl,nlc->nkc", _turned_harmonics(motion[:3, :3], scene.sh_degree).to(like), scene.shN)
    return splats


def _product(turn: Tensor, quats: Tensor) -> Tensor:  # [4], [N, 4] wxyz -> [N, 4]
    w, v = quats[:, :1], quats[:, 1:]
    a, u = turn[:1], turn[1:].expand_as(v)
    return torch.cat([a * w - (u * v).sum(dim=1, keepdim=True), a * v + w * u + torch.linalg.cross(u, v)], dim=1)


def _turned_harmonics(rotation: FloatArray, degree: int) -> Tensor:  # [3, 3] -> [K-1, K-1]
    """M with Y(R⁻¹v)·c = Y(v)·Mc, by least squares over directions: each degree turns within itself."""
    random = np.random.default_rng(0).normal(size=(200, 3))
    directions = torch.from_numpy(random / np.linalg.norm(random, axis=1, keepdims=True))
    basis = spherical_harmonics(directions, degree)[:, 1:]
    turned = spherical_harmonics(directions @ torch.from_numpy(rotation), degree)[:, 1:]
    turning: Tensor = torch.linalg.lstsq(basis, turned).solution
    return turning


class Surface(NamedTuple):
    """The surface of a body, and points all over it."""

    distance: Distance
    points_mm: FloatArray  # [M, 3]
    apart_mm: float  # from a point to its neighbours

    def reached_by(self, scene: GaussianScene) -> BoolArray:  # [N]
        """Whether Gaussians show inside: their middle lies there, or the surface within _SHOWN deviations of it.

        Half the way from point to point widens the Gaussians, so that none slips through between them.
        """
        places = means_mm(scene)
        away = self.distance(places)
        widened = (100.0 * (2.0 * scene.scales).exp() + 0.25 * self.apart_mm**2).sqrt()  # [N, 3] mm
        reached: BoolArray = away < 0.0
        near = np.flatnonzero(~reached & (away < _SHOWN * widened.max(dim=1).values.cpu().numpy()))
        at_once = max(1, _PAIRS // len(self.points_mm))
        for some in (near[first : first + at_once] for first in range(0, len(near), at_once)):
            offsets = torch.from_numpy(self.points_mm - places[some, None]).to(widened)  # [n, M, 3]
            apart = torch.einsum("nmi,nij->nmj", offsets, _axes(part(scene, some))) / widened[some, None]
            reached[some] = (apart.square().sum(dim=2).amin(dim=1) < _SHOWN**2).cpu().numpy()
        return reached


def split(scene: GaussianScene, surface: Surface, longest_mm: float) -> tuple[GaussianScene, int]:
    """The scene in which Gaussians that reach into a body are no longer than `longest_mm`: they are halved, repeatedly.

    With the number of those that stay whole, which come first.

    A half has mean and variance of half of a normal distribution along the axis, and is so much thinner across it that
    frames are covered as before. Both halves are as transparent.
    """
    stay = len(scene.means)
    while True:
        longest, axis = scene.scales.max(dim=1)
        long = np.flatnonzero(10.0 * longest.exp().cpu().numpy() > longest_mm)
        if len(long):
            long = long[surface.reached_by(part(scene, long))]
        if not len(long):
            return scene, stay
        stay -= int((long < stay).sum())
        chosen = torch.zeros(len(scene.means), dtype=torch.bool, device=scene.means.device)
        chosen[torch.from_numpy(long).to(chosen.device)] = True
        whole = part(scene, chosen)
        along = torch.zeros_like(whole.scales).scatter_(1, axis[chosen][:, None], 1.0)
        way = torch.einsum("nij,nj->ni", _axes(whole), along * _HALF_MEAN * whole.scales.exp())
        thinner = _THINNER * math.log(0.5 / _HALF_DEVIATION)
        scales = whole.scales + along * math.log(_HALF_DEVIATION) + (1.0 - along) * thinner
        halves = [
            rebuilt(whole, {**whole.splats, "means": whole.means + side * way, "scales": scales}, whole.labels)
            for side in (-1.0, 1.0)
        ]
        scene = stacked(scene, halves if bool(chosen.all()) else [part(scene, ~chosen), *halves])


def stacked(scene: GaussianScene, parts: list[GaussianScene]) -> GaussianScene:
    """Parts of one scene, together."""
    splats = {name: torch.cat([getattr(one, name) for one in parts]) for name in PARAMETERS}
    labels = [one.labels for one in parts if one.labels is not None]
    return rebuilt(scene, splats, torch.cat(labels) if labels else None)


def _axes(scene: GaussianScene) -> Tensor:  # [N, 3, 3] columns
    by_scale = inverse_root_covariance(scene, torch.eye(3).to(scene.means))
    return (by_scale * scene.scales.exp()[:, :, None]).transpose(1, 2)


def clipped(scene: GaussianScene, distance: Distance, sharpness: float) -> GaussianScene | None:
    """What a surface leaves of the Gaussians inside it; None where nothing is inside.

    A Gaussian that the surface meets becomes what has mean and covariance of its part inside, the surface taken as the
    plane it is nearby: with β = −d/σₙ, d the distance of its mean and σₙ its deviation along the normal n, the part has
    along n the mean d − σₙλ and the variance σₙ²(1 − βλ − λ²), λ = φ(β)/Φ(β). Its tail across the surface is kept
    below exp(−sharpness²/2). Its transmittance is such that it attenuates as the part did.
    """
    places = means_mm(scene)
    away = distance(places)
    reach = 10.0 * scene.scales.exp().max(dim=1).values.cpu().numpy()
    whole = away < -_REACH * reach
    met = ~whole & (away < _REACH * reach)
    if not (whole | met).any():
        return None
    if not met.any():
        return part(scene, whole)
    cut = part(scene, met)
    normal = torch.from_numpy(normals_of(distance, places[met])).to(cut.means)
    axes = _axes(cut)
    covariance = torch.einsum("nij,nj,nkj->nik", axes, (2.0 * cut.scales).exp(), axes)
    along = torch.einsum("nij,nj->ni", covariance, normal)
    sigma = (along * normal).sum(dim=1).sqrt()  # [N] along the normal
    d = torch.from_numpy(away[met] / 10.0).to(cut.means)
    beta = -d / sigma
    share = torch.special.ndtr(beta)
    ratio = torch.exp(-0.5 * beta.square()) / math.sqrt(2.0 * math.pi) / share.clamp(min=1e-6)
    mean = d - sigma * ratio
    deviation = sigma * (1.0 - beta * ratio - ratio.square()).clamp(min=1e-4).sqrt()
    deviation = torch.minimum(deviation, mean.abs() / sharpness).clamp(min=1e-4)
    unit = along / sigma[:, None]
    means = cut.means + unit / sigma[:, None] * (mean - d)[:, None]
    shrunk = (1.0 - (deviation / sigma).square())[:, None, None] * unit[:, :, None] * unit[:, None, :]
    variances, vectors = torch.linalg.eigh((covariance - shrunk).double())
    vectors[:, :, 0] *= torch.linalg.det(vectors).sign()[:, None]
    quats = quaternions(vectors.cpu().numpy())
    ended = (1.0 - torch.sigmoid(cut.transmittances)) * share * sigma / deviation
    kept = (share > _LEAST_SHARE) & (mean < 0.0)
    splats = {
        **cut.splats,
        "means": means,
        "scales": (0.5 * variances.clamp(min=1e-8).log()).to(cut.scales),
        "quats": torch.from_numpy(quats).to(cut.quats),
        "transmittances": torch.logit(1.0 - ended.clamp(0.0, 1.0), eps=1e-6),
    }
    inside = beta > _REACH  # the surface is beyond what it shows
    for name in splats:
        splats[name] = torch.where(inside.reshape(-1, *[1] * (splats[name].ndim - 1)), cut.splats[name], splats[name])
    parts = [part(scene, whole)] if whole.any() else []
    if (kept | inside).any():
        parts.append(part(rebuilt(cut, splats, cut.labels), kept | inside))
    return stacked(scene, parts) if parts else None


def normals_of(distance: Distance, places: FloatArray) -> FloatArray:  # [N, 3] mm -> [N, 3]
    steps = _STEP_MM * np.eye(3)
    slopes = np.stack([distance(places + step) - distance(places - step) for step in steps], axis=1)
    lengths = np.linalg.norm(slopes, axis=1, keepdims=True)
    normals: FloatArray = np.where(lengths > 1e-9, slopes / np.maximum(lengths, 1e-9), [0.0, 0.0, 1.0])
    return normals


def quaternions(rotations: FloatArray) -> FloatArray:  # [N, 3, 3] -> [N, 4] wxyz
    turns = turns_of(rotations)
    half = 0.5 * np.linalg.norm(turns, axis=1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * turns * np.sinc(half / np.pi)], axis=1)

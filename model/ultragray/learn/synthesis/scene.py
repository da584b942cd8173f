"""scene_from_labels(): bodies of tissue become Gaussians, with echo, attenuation, edges and speckle.

Space is divided into cubes, in eight again and again where more than one body is in one, and a Gaussian lies in each:
small ones at surfaces, which clip them (`editing.parts.clipped`). On surfaces between tissues of different impedance
lie flat ones, bright for a beam that meets them face on.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ultragray.errors import InvalidArgument
from ultragray.geometry.probe import FloatArray
from ultragray.learn.editing.parts import SH_C0, Distance, clipped, harmonics_of, quaternions
from ultragray.learn.sweep import ByteArray, IntArray
from ultragray.learn.synthesis.beams import DARK, Losses, blurred, interpolated, losses, scan_poses
from ultragray.learn.synthesis.space import BodySpace
from ultragray.rendering.backends.inputs import spatial_order
from ultragray.scene.gaussians import PARAMETERS, GaussianScene
from ultragray.scene.info import SceneInfo
from ultragray.scene.recipes import SceneRecipe
from ultragray.scene.speckle import BANDS, LEVELS, SpeckleModel
from ultragray.scene.tissues import reflection_db

SPACING = 1.2  # of Gaussians, in their deviations: nine lie over each point
DIVISIONS = 2  # of the largest cubes at most
LARGEST_MM = 3.0  # of a cube
LEAST_SPACING_MM = 0.3
SHARPNESS = 2.5  # of bodies at their surfaces, in deviations of what is clipped
GRAIN = 3.0  # deviations of echo over that of their mean: nine Gaussians lie over each point
MOST_LAYERS = 4  # of Gaussians on a surface
LEAST_CONTRAST_DB = 3.0  # of a surface over what is beside it
OPAQUE = 1.0  # of the logarithm of two impedances' ratio: bone, gas
SOFT_TISSUE_MRAYL = 1.63
SPEED_MM_PER_US = 1.54
BRIGHTEST = 0.98
MOST_BRIGHTENED = 3.0  # times its own echo, of a tissue behind fluid
_C1 = 0.4886025119029199  # of harmonics of degree 1
_LEAST_ALPHA = 1.0 / 255.0
# Weights of Gaussians over a point of a surface, summed: those of bodies, one in each cube, of which clipping leaves
# six tenths there (as measured), and those of one layer of the surface, in each cube whose middle is at most 0.75 of
# its side from it.
_OF_BODIES = 0.6 * (math.sqrt(2.0 * math.pi) / SPACING) ** 3
_OF_LAYER = 1.5 * 2.0 * math.pi / SPACING**2
_TRIES = 4  # of the size of the cubes
_VOXEL, _BLUR = 0.4, 0.42  # of a cube's side: finer than a layer of one cube, which is lost otherwise


def scene_from_labels(
    recipe: SceneRecipe, *, space: BodySpace | None = None, poses: FloatArray | None = None
) -> GaussianScene:  # poses [P, 4, 4] mm
    """The scene of a recipe. `poses`: the sweep, instead of the one that the recipe says; `space`: where bodies are,
    instead of its label map and shapes.

    All of its labels are named in `made_labels`: none of it was recorded. Raises InvalidArgument, ExtraMissing.
    """
    space = BodySpace.of(recipe) if space is None else space
    poses = scan_poses(space, recipe) if poses is None else poses
    lost = losses(space, recipe, poses)
    cubes = _Cubes.about(recipe.gaussian_count, space, lost)
    builder = _Builder(recipe, space, lost, cubes, poses)
    parts = [part for number in range(1, len(space.bodies) + 1) for part in builder.body(number)]
    if not parts:
        raise InvalidArgument("the sweep shows none of the bodies", field="bodies")
    names = tuple(dict.fromkeys(space.bodies[number - 1].label_name for _, number in parts))
    splats = {name: torch.cat([splats[name] for splats, _ in parts]) for name in PARAMETERS}
    labels = torch.cat(
        [
            torch.full((len(splats["means"]),), 1 + names.index(space.bodies[number - 1].label_name), dtype=torch.uint8)
            for splats, number in parts
        ]
    )
    order = spatial_order(splats["means"])
    description = recipe.recorded()
    info = replace(
        builder.info,
        image_height=recipe.image_size,
        image_width=recipe.image_size,
        label_names=dict(enumerate(names, 1)),
        speckle=speckle_of(recipe),
        provenance={
            "parents": {},
            "edits": [description],
            "made": list(range(1, len(names) + 1)),
        },
    )
    return GaussianScene.from_splats(
        {name: tensor[order].contiguous() for name, tensor in splats.items()},
        info=info,
        training_poses=poses,
        labels=labels[order].contiguous(),
    )


def speckle_of(recipe: SceneRecipe) -> SpeckleModel:
    """Fully developed speckle of a scanner of this frequency: a pulse of one and a half waves, and a beam that is one
    and a half waves wide at half the depth of the image.

    The logarithm of an exponentially distributed power has a deviation of 5.57 dB, whatever its mean.
    """
    wave_mm = SPEED_MM_PER_US / recipe.frequency_mhz
    depth_mm = recipe.scanner.scan_line_length_mm
    bands = depth_mm * ((np.arange(BANDS) + 0.5) / BANDS - 0.5)
    lateral = np.hypot(1.1 * wave_mm, 0.011 * bands)
    elevation = np.hypot(2.0 * wave_mm, 0.022 * bands)
    axial = pulse_mm(recipe)
    strength = 10.0 / math.log(10.0) * math.pi / math.sqrt(6.0) / recipe.dynamic_range_db
    return SpeckleModel(
        seed=recipe.seed,
        axial_mm=(axial,) * BANDS,
        lateral_mm=tuple(lateral.tolist()),
        elevation_mm=tuple(elevation.tolist()),
        cell_mm=(1.5 * float(lateral.min()), 1.5 * float(elevation.min()), 1.5 * axial),
        strength=tuple(float(min(strength, level)) for level in np.linspace(0.0, 1.0, LEVELS)),
        wavenumber_per_mm=4.0 * math.pi / wave_mm,
    )


class _Cubes:
    """Cubes of three sizes that fill the bodies, as far as the sweep shows them."""

    def __init__(self, spacing_mm: float, space: BodySpace, lost: Losses) -> None:
        self.spacing_mm = spacing_mm
        side = spacing_mm * 2 ** min(DIVISIONS, max(0, int(math.log2(LARGEST_MM / spacing_mm))))
        counts = np.ceil((lost.high_mm - lost.low_mm) / side).astype(int) + 1
        cubes = lost.low_mm + side * np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(
            -1, 3
        )
        cubes = cubes[lost.shows(cubes)]
        around = np.stack(np.meshgrid(*3 * [[-0.75, 0.0, 0.75]], indexing="ij"), axis=-1).reshape(-1, 3)
        eighths = np.stack(np.meshgrid(*3 * [[-0.25, 0.25]], indexing="ij"), axis=-1).reshape(-1, 3)
        levels: list[tuple[FloatArray, FloatArray, ByteArray]] = []
        while len(cubes):
            if side < 1.5 * spacing_mm:
                numbers, mixed = space.number_at(cubes), np.zeros(len(cubes), bool)
            else:
                places = (cubes[:, None] + side * around).reshape(-1, 3)
                sampled = space.number_at(places).reshape(len(cubes), len(around))
                mixed, numbers = (sampled != sampled[:, :1]).any(axis=1), sampled[:, 0]
            kept = ~mixed & (numbers > 0)
            levels.append((cubes[kept], np.full(int(kept.sum()), side), numbers[kept]))
            cubes = (cubes[mixed][:, None] + side * eighths).reshape(-1, 3)
            side /= 2.0
        self.middles = np.concatenate([one[0] for one in levels])  # [N, 3] mm
        self.sides = np.concatenate([one[1] for one in levels])  # [N] mm
        self.numbers = np.concatenate([one[2] for one in levels])  # [N] of bodies

    @classmethod
    def about(cls, count: int, space: BodySpace, lost: Losses) -> _Cubes:
        """About so many: most lie at surfaces, so that their number falls with the square of their size or faster."""
        volume = float((lost.seen > 0.0).sum())
        cubes = cls(max(LEAST_SPACING_MM, 0.6 * (volume / count) ** (1.0 / 3.0)), space, lost)
        for _ in range(_TRIES):
            share = len(cubes.middles) / count
            if 0.8 < share < 1.1 or (share < 1.0 and cubes.spacing_mm <= LEAST_SPACING_MM):
                break
            cubes = cls(max(LEAST_SPACING_MM, cubes.spacing_mm * share**0.4), space, lost)
        return cubes


class _Builder:
    """The Gaussians of each body, as raw parameters in cm about the middle of all that is seen."""

    def __init__(self, recipe: SceneRecipe, space: BodySpace, lost: Losses, cubes: _Cubes, poses: FloatArray) -> None:
        self._recipe, self._space, self._lost, self._cubes = recipe, space, lost, cubes
        self._axes, self._origins = poses[:, :3, 2], poses[:, :3, 3]
        self._random = np.random.default_rng(recipe.seed)
        self._centre = 0.5 * (lost.low_mm + lost.high_mm)
        self.info = SceneInfo(
            centre_mm=tuple(self._centre.tolist()), probe=recipe.scanner, intensity="sigmoid", sh_degree=1
        )
        self._voxel_mm = _VOXEL * cubes.spacing_mm
        shape = np.ceil((lost.high_mm - lost.low_mm) / self._voxel_mm).astype(int) + 1
        self._blur_mm = max(_BLUR * cubes.spacing_mm, 0.6 * space.resolution_mm)
        self._voxels = np.empty(tuple(shape), np.uint8)
        for index, plane in enumerate(self._voxels):  # a plane at once bounds the memory
            j, k = (axis.ravel() for axis in np.meshgrid(*map(np.arange, shape[1:]), indexing="ij"))
            points = lost.low_mm + self._voxel_mm * np.stack([np.full_like(j, index), j, k], axis=1)
            plane[:] = space.number_at(points).reshape(plane.shape)

    def body(self, number: int) -> list[tuple[dict[str, Tensor], int]]:
        """The Gaussians in a body, then those on its surface towards others."""
        own = self._cubes.numbers == number
        if not own.any():
            return []
        share = blurred((self._voxels == number).astype(np.float32), self._blur_mm / self._voxel_mm)

        def distance(points: FloatArray) -> FloatArray:  # of a plane that is blurred so; mm, negative inside
            inside = interpolated(share, (points - self._lost.low_mm) / self._voxel_mm)
            deviations = torch.special.ndtri(torch.from_numpy(inside).double().clamp(1e-6, 1.0 - 1e-6))
            away: FloatArray = -self._blur_mm * deviations.numpy()
            return away

        middles, sides = self._cubes.middles[own], self._cubes.sides[own]
        finest = sides < 1.5 * self._cubes.spacing_mm
        filled = self._filled(number, middles, sides)
        inner = {name: tensor[torch.from_numpy(~finest)] for name, tensor in filled.items()}
        parts = [(inner, number)] if (~finest).any() else []
        if finest.any():
            outer = {name: tensor[torch.from_numpy(finest)] for name, tensor in filled.items()}
            scene = clipped(GaussianScene.from_splats(outer, info=self.info), distance, SHARPNESS)
            if scene is not None:
                parts.append(({name: raw.detach() for name, raw in scene.splats.items()}, number))
            surface = self._surface(number, middles[finest], distance)
            if surface is not None:
                parts.append((surface, number))
        return parts

    def _grey(self, echo_db: float) -> float:
        return min(max(self._recipe.level + echo_db / self._recipe.dynamic_range_db, 0.0), BRIGHTEST)

    def _seen(self, grey: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The echo that shows a grey level as physics has it, and B-mode without texture (see `beams`)."""
        lost_db, depth = self._lost.at(points)
        bmode = np.clip(grey - lost_db / self._recipe.dynamic_range_db, 0.0, BRIGHTEST)
        lit = np.clip(2.0 * bmode / np.maximum(grey, 1e-3), 0.0, 1.0)  # in a shadow the echo is the tissue's own
        echo = lit * bmode * np.exp(np.minimum(depth, 20.0)) + (1.0 - lit) * grey
        return np.minimum(echo, np.minimum(MOST_BRIGHTENED * grey, BRIGHTEST)), bmode

    def _filled(self, number: int, middles: FloatArray, sides: FloatArray) -> dict[str, Tensor]:
        recipe, tissue = self._recipe, self._space.bodies[number - 1].acoustics
        count = len(middles)
        shaken = middles + 0.1 * sides[:, None] * self._random.normal(size=(count, 3))
        grey = np.full(count, self._grey(tissue.echo_db))
        echo, bmode = self._seen(grey, shaken)
        echo = echo + GRAIN * tissue.texture_db / recipe.dynamic_range_db * self._random.normal(size=count)
        excess_db = 2.0 * recipe.frequency_mhz * max(tissue.attenuation - recipe.compensated, 0.0)  # per cm
        rates = excess_db / (recipe.dynamic_range_db * np.maximum(bmode, DARK))  # −d log T per cm
        ended = np.zeros(count)  # 1 − τ
        for side in np.unique(sides):
            here = sides == side
            ended[here] = opacity_of(rates[here], side / 10.0)
        sigma = np.repeat(sides[:, None] / SPACING, 3, axis=1)
        quats = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        return self._splats(shaken, sigma, quats, ended, echo, np.zeros((count, 3)))

    def _surface(self, number: int, middles: FloatArray, distance: Distance) -> dict[str, Tensor] | None:
        """Flat Gaussians where the body ends and another of a different impedance begins."""
        step = 0.25 * self._voxel_mm
        axes = step * np.eye(3)
        away = distance(middles)
        near = np.abs(away) < 0.75 * self._cubes.spacing_mm
        middles, away = middles[near], away[near]
        slope = np.stack([distance(middles + axis) - distance(middles - axis) for axis in axes], axis=1)
        steepness = np.linalg.norm(slope, axis=1)
        kept = steepness > step  # half as steep as a distance
        normals = slope[kept] / steepness[kept, None]  # outwards
        places = middles[kept] - away[kept, None] * normals
        others = self._space.number_at(places + (self._voxel_mm + 0.5 * self._space.resolution_mm) * normals)
        own = self._space.bodies[number - 1].acoustics
        beside = [None, *(body.acoustics for body in self._space.bodies)]
        echo_db = np.array(
            [-math.inf if one is None else reflection_db(own.impedance, one.impedance) for one in beside]
        )[others]
        around_db = np.array([own.echo_db if one is None else max(own.echo_db, one.echo_db) for one in beside])[others]
        beams, seen_along = self._beams(places)
        across = (normals * beams).sum(axis=1)
        # From what reflects nearly all, such as bone, no beam comes out again: its far side is not seen.
        odd = np.array(
            [0.0 if one is None else abs(math.log(one.impedance / own.impedance)) > OPAQUE for one in beside]
        )[others].astype(bool)
        inwards = across * (1.0 if abs(math.log(own.impedance / SOFT_TISSUE_MRAYL)) < OPAQUE else -1.0) > 0.0
        bright = (echo_db > around_db + LEAST_CONTRAST_DB) & (inwards | ~odd)
        if not bright.any():
            return None
        levels = [np.array([self._grey(float(db)) for db in each[bright]]) for each in (echo_db, around_db)]
        facing, aside = (self._seen(grey, places[bright])[0].clip(0.01, BRIGHTEST) for grey in levels)
        layers = layers_of((facing - aside) / (BRIGHTEST - aside).clip(1e-3))
        which = np.repeat(np.flatnonzero(bright), layers)
        facing, aside, layers = (np.repeat(each, layers) for each in (facing, aside, layers))
        places, normals = places[which], normals[which]
        # Gaussians of bodies lie there, too, and show what is beside it. With their weight as 1, that of the surface
        # falls from `over` as a Gaussian g, its share over·g/(1 + over·g) to a half where g = 1/(2 + over).
        over = _OF_LAYER * layers / _OF_BODIES
        facing = (aside + (facing - aside) * (1.0 + 1.0 / over)).clip(0.01, BRIGHTEST)
        narrower = np.sqrt(math.log(2.0) / np.log(2.0 + over))
        lobe = turned(normals * np.sign(across[which])[:, None], beams[which], seen_along[which])
        # sigmoid(4·(a + b·cosine)) is `facing` at a cosine of 1 and `aside` at 0, where the beam runs along the surface
        logit_facing, logit_aside = (np.log(one / (1.0 - one)) / 4.0 for one in (facing, aside))
        rise = np.maximum(logit_facing - logit_aside, 0.0)
        sigma = np.tile([0.0, *2 * [self._cubes.spacing_mm / SPACING]], (len(which), 1))
        sigma[:, 0] = narrower * surface_mm(self._recipe, (echo_db - around_db)[which])
        return self._splats(
            places, sigma, quaternions(_frames(normals)), np.zeros(len(which)), None, lobe, logit_facing, rise
        )

    def _beams(self, places: FloatArray) -> tuple[FloatArray, FloatArray]:  # [N, 3] mm -> [N, 3] both, unit
        """The direction of the beam at each place, from the pose of the sweep beside it, and that of the model there.

        The model takes the direction from the probe's origin, which is the beam's where lines fan out from there.
        """
        way = self._origins[-1] - self._origins[0]
        order = np.argsort(self._origins @ way)
        place = np.searchsorted((self._origins @ way)[order], places @ way).clip(0, len(order) - 1)
        seen_along: FloatArray = places - self._origins[order[place]]
        seen_along /= np.maximum(np.linalg.norm(seen_along, axis=1, keepdims=True), 1e-9)
        return (self._axes[order[place]] if self._recipe.scanner.lines.are_upright else seen_along), seen_along

    def _splats(
        self,
        places: FloatArray,  # [N, 3] mm
        sigma: FloatArray,  # [N, 3] mm
        quats: FloatArray,  # [N, 4]
        ended: FloatArray,  # [N] 1 − τ
        echo: FloatArray | None,  # [N]; None: by the lobe
        lobe: FloatArray,  # [N, 3] unit: the direction of the beam in which a surface is brightest
        logit: FloatArray | float = 0.0,  # [N] there, quartered
        rise: FloatArray | float = 0.0,  # [N] by the cosine of the angle to it
    ) -> dict[str, Tensor]:
        if echo is None:
            sh0 = torch.from_numpy(np.asarray(logit - rise) / SH_C0).reshape(-1, 1, 1)
        else:
            sh0, _ = harmonics_of(torch.from_numpy(echo))
        x, y, z = (rise * lobe.T) / _C1
        tensors = {
            "means": torch.from_numpy((places - self._centre) / 10.0),
            "scales": torch.from_numpy(np.log(sigma / 10.0)),
            "quats": torch.from_numpy(quats),
            "transmittances": torch.logit(torch.from_numpy(1.0 - ended), eps=1e-6),
            "sh0": sh0,
            "shN": torch.from_numpy(np.stack([-y, z, -x], axis=1)[..., None]),
        }
        return {name: tensor.float().contiguous() for name, tensor in tensors.items()}


def turned(vectors: FloatArray, before: FloatArray, after: FloatArray) -> FloatArray:  # [N, 3] each, the last two unit
    """Vectors after the least rotation that leads one direction into another."""
    both = before + after
    half = 0.5 * (both * both).sum(axis=1, keepdims=True)
    share = (both * vectors).sum(axis=1, keepdims=True) / np.maximum(half, 1e-9)
    result: FloatArray = vectors - share * both + 2.0 * (before * vectors).sum(axis=1, keepdims=True) * after
    return result


def layers_of(share: FloatArray) -> IntArray:  # [N] -> [N]
    """How many layers of Gaussians give a surface such a share of all weights there; MOST_LAYERS at most."""
    needed = share / (1.0 - share).clip(1e-6) * _OF_BODIES / _OF_LAYER
    counts: IntArray = np.ceil(needed).clip(1, MOST_LAYERS).astype(int)
    return counts


def surface_mm(recipe: SceneRecipe, contrast_db: FloatArray) -> FloatArray:  # [N] -> [N]
    """The deviation across it with which a surface shows that is so much brighter than what is beside it.

    The envelope exp(−z²/2σ²) of a pulse is a parabola in decibels, which rises above what is beside it as far as
    zₘ = σ·√(2·contrast/8.69): the brighter, the wider. A Gaussian as high and of the same area deviates by
    4/3·zₘ/√(2π), so that a surface is as bright in the mean.
    """
    reach_mm = pulse_mm(recipe) * np.sqrt(np.clip(contrast_db, 0.0, recipe.dynamic_range_db) * math.log(10.0) / 10.0)
    deviations: FloatArray = 4.0 / 3.0 / math.sqrt(2.0 * math.pi) * reach_mm
    return deviations


def pulse_mm(recipe: SceneRecipe) -> float:
    """The deviation of the envelope of a pulse of one and a half waves, along depth."""
    return 0.55 * SPEED_MM_PER_US / recipe.frequency_mhz


def _frames(normals: FloatArray) -> FloatArray:  # [N, 3] -> [N, 3, 3] rotations whose first column is the normal
    other = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    second = np.cross(normals, other)
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    return np.stack([normals, second, np.cross(normals, second)], axis=2)


def opacity_of(rates: FloatArray, spacing_cm: float) -> FloatArray:  # [N] per cm -> [N]
    """1 − τ of round Gaussians, one in each cube of a lattice, by which a beam loses exp(−rate) of itself in a cm.

    A beam loses −log(1 − α·(1 − τ)) where it passes a Gaussian, α = 1 − exp(−ψ₀·exp(−m²/2)), m deviations from its
    middle, ψ₀ = 1.153·√(2π)·σ (docs/physics.md §3); as long as m² ≤ 9 and α ≥ 1/255. Integrated over all ways by it,
    times one Gaussian in a cube, that is the rate.
    """
    sigma = spacing_cm / SPACING
    u = np.linspace(0.0, 4.5, 2001)
    alpha = -np.expm1(-1.153 * math.sqrt(2.0 * math.pi) * sigma * np.exp(-u))
    alpha[alpha < _LEAST_ALPHA] = 0.0
    opacities = np.linspace(0.0, 1.0, 101)
    lost = -np.log1p(-alpha * opacities[:, None]).mean(axis=1) * 4.5
    reached = 2.0 * math.pi * sigma**2 * lost / spacing_cm**3
    values: FloatArray = np.interp(rates, reached, opacities)
    return values

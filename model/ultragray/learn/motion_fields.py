"""Modes of motion from fields that are given: a chest, a vessel that pulsates, the voxels of a file.

Each is a function of points of the tissue at rest. `with_mode` fits splines to it by least squares and gives the scene
one mode more. All modes of a scene have one grid: where the new one wants a finer grid, the others are fitted to that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor

from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray
from ultragray.scene.deformation import LEAST_SIDE, Displacement, along_axes, spline_basis
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.info import SceneInfo, with_summary
from ultragray.scene.label_maps import VectorField
from ultragray.scene.modes import MAX_COEFFICIENT_BYTES, MAX_SIDE, Mode, Motion, Moving
from ultragray.scene.motion_settings import FIELD_LEADS
from ultragray.scene.shapes import LabelShape, TubeShape

Field: TypeAlias = Callable[[Tensor], Tensor]  # points [N, 3] mm of the tissue at rest -> [N, 3] mm for one unit

SAMPLES = 3  # of a field from one spline to the next, along each axis
AT_ONCE = 1 << 15  # points at which splines are evaluated: 100 MB
ROOM = 4  # modes that a vessel leaves room for
LEAST_LABELLED = 20  # Gaussians of a vessel
FOLD_MM, FOLD_STEPS = 1e-3, 100  # to which, and by how many steps, a field is inverted


class Grid(NamedTuple):
    """A grid of splines that holds the Gaussians of a scene, with a spline beyond at each end."""

    origin_mm: FloatArray  # [3] of the first spline
    spacing_mm: FloatArray  # [3]
    sides: tuple[int, ...]

    @classmethod
    def over(cls, info: SceneInfo, spacing_mm: float | FloatArray, modes: int = 1) -> Grid:
        """Raises InvalidArgument where so many modes do not fit into a scene file."""
        spacing = np.broadcast_to(np.asarray(spacing_mm, np.float64), 3)
        low, high = np.asarray(info.bounds_min_mm), np.asarray(info.bounds_max_mm)
        sides = np.maximum(np.ceil((high - low) / spacing).astype(int) + 3, LEAST_SIDE)
        if sides.max() > MAX_SIDE or 12 * modes * math.prod(sides.tolist()) > MAX_COEFFICIENT_BYTES:
            raise InvalidArgument(
                f"spacing_mm must be greater where the fields of {modes} modes are to cover a scene of "
                f"{' x '.join(f'{side:.0f}' for side in high - low)} mm, got {spacing.min():g}",
                field="spacing_mm",
            )
        return cls((low + high - spacing * (sides - 1)) / 2.0, spacing, tuple(sides.tolist()))

    def displacement(self, coefficients: Tensor) -> Displacement:  # [C, X, Y, Z, 3] mm
        return Displacement.on_grid(coefficients, self.origin_mm, self.spacing_mm)

    def fit(self, field: Field) -> tuple[Tensor, Residual]:  # [X, Y, Z, 3]
        """Splines next to the field, by least squares of samples on a lattice, and how far they are from it.

        Splines of a grid are products of those along its axes, and the lattice is one of the same axes: the solution is
        the pseudoinverse along one axis after the other.
        """
        lattice = self._lattice_mm()
        bases = self._bases(lattice)
        samples = field(torch.cartesian_prod(*lattice)).reshape(*map(len, lattice), 3)
        coefficients = along_axes(samples, [torch.linalg.pinv(basis) for basis in bases])
        off_mm = (along_axes(coefficients, bases) - samples).norm(dim=-1)
        return coefficients, Residual(float(off_mm.square().mean().sqrt()), float(off_mm.max()))

    def fit_splines(self, of: Grid, coefficients: Tensor) -> Tensor:  # [..., X, Y, Z, 3] both
        """`fit` of splines on another grid."""
        lattice = self._lattice_mm()
        bases = zip(self._bases(lattice), of._bases(lattice), strict=True)
        return along_axes(coefficients, [torch.linalg.pinv(own) @ other for own, other in bases])

    def _lattice_mm(self) -> list[Tensor]:  # of each axis [S]
        places = [torch.linspace(1.0, side - 2.0, SAMPLES * (side - 3) + 1, dtype=torch.float64) for side in self.sides]
        return [self.origin_mm[d] + self.spacing_mm[d] * place for d, place in enumerate(places)]

    def _bases(self, lattice_mm: Sequence[Tensor]) -> list[Tensor]:  # of each axis [S, sides[d]]
        """The splines along each axis; beyond the grid as at its border."""
        return [
            spline_basis(((at - self.origin_mm[d]) / self.spacing_mm[d]).clamp(1.0, side - 2.0), side)
            for d, (at, side) in enumerate(zip(lattice_mm, self.sides, strict=True))
        ]


class Residual(NamedTuple):
    """How far the splines of a mode are from the field that it was given by, within the bounds of the scene."""

    rms_mm: float
    most_mm: float


def with_mode(scene: GaussianScene, mode: Mode, field: Field, spacing_mm: float) -> tuple[GaussianScene, Residual]:
    """The scene with one mode more, the last. Raises as `with_splines`."""
    grid = _common_grid(scene, np.full(3, spacing_mm))
    coefficients, residual = grid.fit(field)
    return with_splines(scene, mode, grid, coefficients), residual


def with_splines(scene: GaussianScene, mode: Mode, grid: Grid, coefficients: Tensor) -> GaussianScene:
    """`with_mode` of a field of splines, [X, Y, Z, 3] mm for one unit.

    Raises InvalidArgument for the name of a mode that the scene has, and for a grid that is too fine for all its modes.
    """
    common = _common_grid(scene, grid.spacing_mm)
    fields = [common.fit_splines(grid, coefficients.double())[None]]
    modes: tuple[Mode, ...] = (mode,)
    if (moving := scene.moving) is not None:
        motion, others = moving.motion, torch.from_numpy(moving.coefficients).double()
        has = Grid(np.array(motion.origin_mm), np.array(motion.spacing_mm), tuple(others.shape[1:4]))
        modes, fields = (*motion.modes, mode), [common.fit_splines(has, others), *fields]
    x, y, z = common.origin_mm.tolist()
    motion = Motion(modes, (x, y, z), tuple(common.spacing_mm.tolist()))
    info = with_summary(scene.info, scene.means.detach().double().numpy(), scene.sh_degree)
    moved = Moving(motion, torch.cat(fields).float().numpy())
    return replace(scene, info=replace(info, motion=motion), moving=moved)


def with_moved_modes(scene: GaussianScene, moving: Moving, by: FloatArray) -> GaussianScene:  # [4, 4] mm
    """A still scene with modes of one that a rigid motion led to where this lies. Raises as `with_splines`."""
    motion, shift, turn = moving.motion, torch.from_numpy(by[:3, 3]), torch.from_numpy(by[:3, :3])
    if np.array_equal(by[:3, :3], np.eye(3)):
        x, y, z = (np.array(motion.origin_mm) + by[:3, 3]).tolist()
        moved = replace(moving, motion=replace(motion, origin_mm=(x, y, z)))
        return replace(scene, info=replace(scene.info, motion=moved.motion), moving=moved)
    for mode, coefficients in zip(motion.modes, torch.from_numpy(moving.coefficients), strict=True):
        before = Displacement.on_grid(coefficients[None], motion.origin_mm, motion.spacing_mm)

        def field(points: Tensor, before: Displacement = before) -> Tensor:
            return torch.cat([before.at((some - shift) @ turn)[0] @ turn.T for some in torch.split(points, AT_ONCE)])

        scene, _ = with_mode(scene, mode, field, min(motion.spacing_mm))
    return scene


def _common_grid(scene: GaussianScene, spacing_mm: FloatArray) -> Grid:  # [3]
    """Of the modes of a scene and one that wants this spacing."""
    if (motion := scene.info.motion) is None:
        return Grid.over(scene.info, spacing_mm)
    return Grid.over(scene.info, np.minimum(spacing_mm, motion.spacing_mm), 1 + len(motion.modes))


def chest(info: SceneInfo, depth_mm: float) -> Field:
    """A chest or belly that breathes by `depth_mm` along the scene's z.

    Deep tissue moves as a whole, away from the skin under the probe, which stays: the motion rises over the first third
    of the scene's depth, where tissue is drawn apart.
    """
    low, high = info.bounds_min_mm[2], info.bounds_max_mm[2]

    def field(points: Tensor) -> Tensor:
        share = ((points[:, 2] - low) / max((high - low) / 3.0, 1.0)).clamp(0.0, 1.0)
        moved = torch.zeros_like(points)
        moved[:, 2] = depth_mm * (1.0 - torch.cos(math.pi * share)) / 2.0
        return moved

    return field


def pulsation(tube: TubeShape, wall_mm: float) -> Field:
    """A vessel whose wall moves out by `wall_mm`.

    Outside nothing is compressed: what passes through cylinders about the vessel is the same through all of them, so
    that the displacement falls as R/r, with R the radius of the vessel and r the distance from its middle. Inside it
    grows with r.
    """
    path, radius = torch.tensor(tube.points_mm, dtype=torch.float64), tube.radius_mm

    def field(points: Tensor) -> Tensor:
        away = torch.full_like(points, torch.inf)
        for start, way in zip(path[:-1].to(points), path.diff(dim=0).to(points), strict=True):
            along = ((points - start) @ way / way.square().sum().clamp(min=1e-12)).clamp(0.0, 1.0)
            apart = points - start - along[:, None] * way
            is_nearer = apart.norm(dim=1, keepdim=True) < away.norm(dim=1, keepdim=True)
            away = torch.where(is_nearer, apart, away)
        moved: Tensor = wall_mm * radius * away / away.norm(dim=1, keepdim=True).clamp(min=radius).square()
        return moved

    return field


def pulsation_spacing_mm(scene: GaussianScene, tube: TubeShape) -> float:
    """Half the radius, or the least there is room for. Raises InvalidArgument where that is more than the radius."""
    modes = 1 + len(() if scene.info.motion is None else scene.info.motion.modes)
    for spacing in map(float, np.geomspace(tube.radius_mm / 2.0, tube.radius_mm, 20)):
        try:
            Grid.over(scene.info, spacing, max(modes, ROOM))
        except InvalidArgument:
            continue
        return spacing
    raise InvalidArgument(
        f"vessel: a radius of {tube.radius_mm:g} mm is too small for the field of a scene of this size: cut the scene, "
        "or give a spacing_mm",
        field="vessel",
    )


def vessel_of(scene: GaussianScene, label: LabelShape) -> TubeShape:
    """The tube that the Gaussians of a label fill: one vessel without branches, which does not turn back.

    Its middle is that of slices across its longest axis; its radius follows from the mean square of the distance from
    the middle, R²/2 in a full disc. Raises InvalidArgument for another label, or fewer than LEAST_LABELLED Gaussians.
    """
    numbers = [number for number, name in scene.info.label_names.items() if name == label.name]
    inside = torch.zeros(len(scene.means), dtype=torch.bool)
    if scene.labels is not None:
        inside = torch.isin(scene.labels, torch.tensor(numbers, dtype=torch.uint8))
    if (count := int(inside.sum())) < LEAST_LABELLED:
        known = ", ".join(scene.info.label_names.values()) or "none"
        raise InvalidArgument(
            f"vessel: a label needs {LEAST_LABELLED} Gaussians or more, {label.name!r} has {count}; labels: {known}",
            field="vessel",
        )
    points = np.asarray(scene.info.centre_mm) + 10.0 * scene.means[inside].detach().double().numpy()
    middle = points.mean(axis=0)
    _, spread, axes = np.linalg.svd(points - middle, full_matrices=False)
    along = (points - middle) @ axes[0]
    width = 2.0 * math.sqrt(2.0 * float(np.square(spread[1:]).sum()) / count)
    slices = int(np.clip(np.ptp(along) / width, 1, count // LEAST_LABELLED * 2))
    place = np.minimum((slices * (along - along.min()) / np.ptp(along)).astype(int), slices - 1)
    path = np.array([points[place == one].mean(axis=0) for one in np.unique(place)])
    first, last = (
        end + (reach - (end - middle) @ axes[0]) * axes[0]
        for end, reach in zip(path[[0, -1]], np.sort(along)[[0, -1]], strict=True)
    )
    whole = tuple((float(x), float(y), float(z)) for x, y, z in (first, *path, last))
    tube = TubeShape(points_mm=whole, radius_mm=1.0)
    off_mm = tube.distance_mm(points) + tube.radius_mm
    return replace(tube, radius_mm=math.sqrt(2.0 * float(np.square(off_mm).mean())))


def field_of_voxels(
    voxels: VectorField,
    info: SceneInfo,
    leads: str,
    field_to_scene: FloatArray | None = None,  # [4, 4] mm, rigid; None: the file lies in the scene's frame
) -> Field:
    """The displacements of a file, linear between its voxels, and beyond them as at their border.

    `leads`, of FIELD_LEADS. from-rest: the vector of a point of the tissue at rest leads to where it moves. to-rest:
    the vector of a point of the moved tissue leads to where it is at rest, as in a transform that resamples an image at
    rest; it is inverted. Raises InvalidArgument where no part of the scene lies among the voxels; InvalidPose. The
    field raises it where the displacement folds, and has no inverse.
    """
    if leads not in FIELD_LEADS:
        raise InvalidArgument(f"field_leads must be {' or '.join(FIELD_LEADS)}, got {leads!r}", field="field_leads")
    to_mm, vectors = voxels.affine, voxels.vectors
    if field_to_scene is not None:
        pose = check_poses(field_to_scene, field="field_to_scene")[0]
        to_mm, vectors = pose @ to_mm, vectors @ pose[:3, :3].T
    to_voxels = torch.from_numpy(np.linalg.inv(to_mm))
    last = torch.tensor(vectors.shape[:3], dtype=torch.float64) - 1.0
    corners = torch.cartesian_prod(*torch.tensor([info.bounds_min_mm, info.bounds_max_mm], dtype=torch.float64).T)
    reach = corners @ to_voxels[:3, :3].T + to_voxels[:3, 3]
    if (reach.amax(dim=0) < 0.0).any() or (reach.amin(dim=0) > last).any():
        raise InvalidArgument(
            "the field lies beyond the scene: is it registered to the frame of the scene, in mm?", field="field"
        )
    volume = torch.from_numpy(vectors).permute(3, 2, 1, 0)[None]

    def looked_up(points: Tensor) -> Tensor:
        places = (points @ to_voxels[:3, :3].T + to_voxels[:3, 3]) * 2.0 / last.clamp(min=1.0) - 1.0
        values = torch.nn.functional.grid_sample(
            volume, places[None, None, None], mode="bilinear", padding_mode="border", align_corners=True
        )
        return values[0, :, 0, 0].T

    def inverted(points: Tensor) -> Tensor:
        moved = points
        for _ in range(FOLD_STEPS):  # x + u(x) = p, so x is where p − u(x) stays
            before, moved = moved, points - looked_up(moved)
            if (moved - before).abs().max() < FOLD_MM:
                return moved - points
        raise InvalidArgument("the field folds: where it leads to rest, it has no inverse", field="field")

    return {"from-rest": looked_up, "to-rest": inverted}[leads]

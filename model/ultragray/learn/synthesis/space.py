"""The bodies of a recipe in space: which one is at a point."""

from __future__ import annotations

import base64
import binascii
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ultragray.contract import under
from ultragray.errors import InvalidArgument
from ultragray.geometry.probe import FloatArray
from ultragray.learn.sweep import ByteArray
from ultragray.scene.label_maps import read_label_map, read_volume
from ultragray.scene.recipes import SceneRecipe, TissueBody

# Tissues of a CT by its Hounsfield units: usual thresholds of body composition, of what lies within the skin.
CT_TISSUES = ((-190.0, "gas"), (-30.0, "fat"), (200.0, "muscle"), (np.inf, "bone"))
SHAPES_RESOLUTION_MM = 0.5  # to which shapes are drawn


@dataclass(frozen=True)
class BodySpace:
    """Bodies by number from 1, and the number at a point."""

    bodies: tuple[TissueBody, ...]
    number_at: Callable[[FloatArray], ByteArray]  # [N, 3] mm -> [N], 0: nothing
    low_mm: FloatArray  # [3] of a box around all
    high_mm: FloatArray
    resolution_mm: float

    @classmethod
    def of(cls, recipe: SceneRecipe) -> BodySpace:
        """Raises InvalidArgument, ExtraMissing."""
        if recipe.label_map is None and any(body.label is not None for body in recipe.bodies):
            raise InvalidArgument("label_map must be given where bodies have a label in it", field="label_map")
        bodies = recipe.bodies
        layers: list[_Voxels | _Drawn] = []
        if recipe.ct is not None:
            values, affine = _read(recipe.ct, recipe.ct_format, "ct")
            bodies, numbers = _of_ct(bodies, values)
            layers.append(_Voxels(numbers, affine))
        if recipe.label_map is not None:
            labels, affine = _read(recipe.label_map, recipe.label_map_format, "label_map")
            table = np.zeros(256, np.uint8)
            for number, body in enumerate(recipe.bodies, 1):
                if body.label is not None:
                    table[body.label] = number
            layers.append(_Voxels(table[labels], affine))
        for number, body in enumerate(recipe.bodies, 1):
            if body.shape is not None:
                with under(f"bodies[{number - 1}].shape"):
                    layers.append(_Drawn(body, number, *body.shape.bounds_mm()))

        def number_at(points: FloatArray) -> ByteArray:
            at_points = np.zeros(len(points), np.uint8)
            for layer in layers:
                layer.draw(points, at_points)
            return at_points

        boxes = np.array([layer.bounds_mm() for layer in layers])
        resolution = min(layer.resolution_mm for layer in layers)
        return cls(bodies, number_at, boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0), resolution)


class _Voxels:
    """Numbers of bodies [I, J, K]."""

    def __init__(self, numbers: ByteArray, affine: FloatArray) -> None:
        filled = np.argwhere(numbers)
        if not len(filled):
            raise InvalidArgument("the label map holds none of the labels of bodies", field="bodies")
        self._numbers, self._to_mm, self._to_voxels = numbers, affine, np.linalg.inv(affine)
        self._first, self._last = filled.min(axis=0) - 0.5, filled.max(axis=0) + 0.5
        self.resolution_mm = float(abs(np.linalg.det(affine[:3, :3])) ** (1.0 / 3.0))

    def draw(self, points: FloatArray, numbers: ByteArray) -> None:
        places = np.rint(points @ self._to_voxels[:3, :3].T + self._to_voxels[:3, 3]).astype(np.int64)
        inside = np.flatnonzero(((places >= 0) & (places < self._numbers.shape)).all(axis=1))
        here = self._numbers[tuple(places[inside].T)]
        numbers[inside[here > 0]] = here[here > 0]

    def bounds_mm(self) -> tuple[FloatArray, FloatArray]:
        corners = np.where(np.argwhere(np.ones((2, 2, 2))) > 0, self._last, self._first)
        places = corners @ self._to_mm[:3, :3].T + self._to_mm[:3, 3]
        return places.min(axis=0), places.max(axis=0)


@dataclass(frozen=True)
class _Drawn:
    """A body that is a shape."""

    body: TissueBody
    number: int
    low_mm: FloatArray
    high_mm: FloatArray
    resolution_mm = SHAPES_RESOLUTION_MM

    def draw(self, points: FloatArray, numbers: ByteArray) -> None:
        assert self.body.shape is not None
        near = np.flatnonzero(((points >= self.low_mm) & (points <= self.high_mm)).all(axis=1))
        if len(near):
            numbers[near[self.body.shape.distance_mm(points[near]) < 0.0]] = self.number

    def bounds_mm(self) -> tuple[FloatArray, FloatArray]:
        return self.low_mm, self.high_mm


def _read(data: str, form: str, field: str) -> tuple[npt.NDArray[Any], FloatArray]:
    try:
        content = base64.b64decode(data, validate=True)
    except (ValueError, binascii.Error):
        raise InvalidArgument(f"{field} must be the file in base64", field=field) from None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"{field}.{form}")
        path.write_bytes(content)
        return read_label_map(path) if field == "label_map" else read_volume(path, field=field)


def _of_ct(bodies: tuple[TissueBody, ...], values: npt.NDArray[Any]) -> tuple[tuple[TissueBody, ...], ByteArray]:
    """The bodies with those that a CT tells, and their numbers in its voxels [I, J, K]."""
    numbers = np.zeros(values.shape, np.uint8)
    above = np.full(values.shape, True)
    for most, tissue in CT_TISSUES:
        here = above & (values < most)
        above &= ~here
        if not here.any():
            continue
        known = next((place for place, body in enumerate(bodies, 1) if body.label_name == tissue), None)
        if known is None:  # a body of a shape or of a label that nothing has
            bodies = (*bodies, TissueBody(tissue=tissue, label=1))
        numbers[here] = known or len(bodies)
    for index in range(values.shape[2]):
        numbers[:, :, index][_outside(values[:, :, index] < CT_TISSUES[0][0])] = 0
    return bodies, numbers


def _outside(is_air: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:  # [I, J]
    """The air of a slice that is connected to its border."""
    _, parts = cv2.connectedComponents(is_air.astype(np.uint8))
    border = np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]])
    outside: npt.NDArray[np.bool_] = is_air & np.isin(parts, np.unique(border[border > 0]))
    return outside

"""Shapes: parts of space that edits of a scene are about, by their signed distance. Free of torch.

Points and shapes are in the scene's frame, mm. A distance is negative inside; it is exact, or so near the surface.
"""

from __future__ import annotations

import base64
import binascii
import io
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from ultragray.contract import Family, described, kind_field
from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import MAX_POSITION_MM
from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import rotations_of
from ultragray.installation import missing_extra

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MAX_DOCUMENT_BYTES = 1 << 26
MAX_SIZE_MM, LEAST_SIZE_MM = 1000.0, 0.1
MAX_TUBE_POINTS = 1000
MAX_FACES = 200_000  # of a mesh
SURFACE_POINTS = 40_000  # that stand for the surface of a mesh
MESH_FORMATS = ("stl", "obj", "ply")
MAP_FORMATS = ("nii", "nii.gz", "nrrd")
_HASHED = "sha256:"  # begins the data of a shape that a scene file tells of


def point_field(meaning: str, *default: Any) -> Any:
    return described(meaning, *default, low=-MAX_POSITION_MM, high=MAX_POSITION_MM)


def _size_field(meaning: str) -> Any:
    return described(meaning, low=LEAST_SIZE_MM, high=MAX_SIZE_MM)


def turn_field() -> Any:
    return described("Axis times angle, degrees, about the axes of the scene.", (0.0,) * 3, low=-360.0, high=360.0)


@dataclass(frozen=True)
class Shape(Family):
    """A part of space in the scene's frame, or the Gaussians of one label."""

    kind: str
    has_surface = True  # whether `distance_mm` is a distance: what is inserted needs one
    is_in_space = True  # whether it is anything without a scene

    def distance_mm(self, points: FloatArray) -> FloatArray:  # [N, 3] mm -> [N]
        """The signed distance of points, negative inside."""
        raise NotImplementedError

    def bounds_mm(self) -> tuple[FloatArray, FloatArray]:  # [3] both
        """A box that holds the shape."""
        raise NotImplementedError

    def recorded(self) -> dict[str, Any]:
        """The shape as a scene file tells it."""
        return {one.name: getattr(self, one.name) for one in fields(self)}


@dataclass(frozen=True)
class SphereShape(Shape):
    """A ball."""

    centre_mm: tuple[float, float, float] = point_field("Its middle.")
    radius_mm: float = _size_field("Its radius.")
    kind: Literal["sphere"] = kind_field("sphere")

    def distance_mm(self, points: FloatArray) -> FloatArray:
        distance: FloatArray = np.linalg.norm(points - np.asarray(self.centre_mm), axis=1) - self.radius_mm
        return distance

    def bounds_mm(self) -> tuple[FloatArray, FloatArray]:
        middle = np.asarray(self.centre_mm)
        return middle - self.radius_mm, middle + self.radius_mm


@dataclass(frozen=True)
class EllipsoidShape(Shape):
    """An ellipsoid; its distance is exact to first order."""

    centre_mm: tuple[float, float, float] = point_field("Its middle.")
    radii_mm: tuple[float, float, float] = _size_field("Half its axes.")
    turn_deg: tuple[float, float, float] = turn_field()
    kind: Literal["ellipsoid"] = kind_field("ellipsoid")

    @cached_property
    def _axes(self) -> FloatArray:  # [3, 3] columns
        axes: FloatArray = rotations_of(np.radians([self.turn_deg]))[0]
        return axes

    def distance_mm(self, points: FloatArray) -> FloatArray:
        radii = np.asarray(self.radii_mm)
        scaled = (points - np.asarray(self.centre_mm)) @ self._axes / radii
        radius = np.linalg.norm(scaled, axis=1)
        steepness = np.linalg.norm(scaled / radii, axis=1)
        distance: FloatArray = (radius - 1.0) * radius / np.maximum(steepness, 1e-9)
        return np.where(steepness > 1e-9, distance, -radii.min())

    def bounds_mm(self) -> tuple[FloatArray, FloatArray]:
        middle, half = np.asarray(self.centre_mm), np.linalg.norm(self._axes * np.asarray(self.radii_mm), axis=1)
        return middle - half, middle + half


@dataclass(frozen=True)
class BoxShape(Shape):
    """A box along the axes of the scene."""

    min_mm: tuple[float, float, float] = point_field("Its least corner.")
    max_mm: tuple[float, float, float] = point_field("Its greatest corner.")
    kind: Literal["box"] = kind_field("box")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not all(high - low >= LEAST_SIZE_MM for low, high in zip(self.min_mm, self.max_mm, strict=True)):
            raise InvalidArgument(
                f"max_mm must be {LEAST_SIZE_MM:g} mm or more above min_mm, got {self.min_mm} and {self.max_mm}",
                field="max_mm",
            )

    def distance_mm(self, points: FloatArray) -> FloatArray:
        low, high = self.bounds_mm()
        beyond = np.abs(points - 0.5 * (low + high)) - 0.5 * (high - low)
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
        distance: FloatArray = outside + np.minimum(beyond.max(axis=1), 0.0)
        return distance

    def bounds_mm(self) -> tuple[FloatArray, FloatArray]:
        return np.asarray(self.min_mm), np.asarray(self.max_mm)


@dataclass(frozen=True)
class TubeShape(Shape):
    """All that lies near a path of straight pieces, such as a vessel."""

    points_mm: tuple[tuple[float, float, float], ...] = described(
        "The path, two points or more.",
        low=-MAX_POSITION_MM,
        high=MAX_POSITION_MM,
        most=MAX_TUBE_POINTS,
        schema={"items": {"type": "array", "prefixItems": [{"type": "number"}] * 3, "minItems": 3, "maxItems": 3}},
    )
    radius_mm: float = _size_field("Its radius.")
    kind: Literal["tube"] = kind_field("tube")

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.points_mm) < 2:
            raise InvalidArgument(f"points_mm must be two or more, got {len(self.points_mm)}", field="points_mm")

    def distance_mm(self, points: FloatArray) -> FloatArray:
        path = np.asarray(self.points_mm)
        nearest = np.full(len(points), np.inf)
        for start, way in zip(path[:-1], np.diff(path, axis=0), strict=True):
            along = np.clip((points - start) @ way / max(float(way @ way), 1e-12), 0.0, 1.0)
            nearest = np.minimum(nearest, np.linalg.norm(points - start - along[:, None] * way, axis=1))
        return nearest - self.radius_mm

    def bounds_mm(self) -> tuple[FloatArray, FloatArray]:
        path = np.asarray(self.points_mm)
        return path.min(axis=0) - self.radius_mm, path.max(axis=0) + self.radius_mm


class OfFile:
    """A part of a contract that is of a file, which travels inside the document. Its members have `data`."""

    formats: ClassVar[tuple[str, ...]]

    def content(self) -> bytes:
        data: str = self.data  # type: ignore[attr-defined]
        try:
            return base64.b64decode(data, validate=True)
        except (ValueError, binascii.Error):
            raise InvalidArgument("data must be the file in base64", field="data") from None

    def recorded(self) -> dict[str, Any]:
        """All but the content, in whose place is its hash."""
        part: Any = self
        return {one.name: getattr(part, one.name) for one in fields(part)} | {
            "data": _HASHED + sha256(part.data.encode()).hexdigest()
        }

    @classmethod
    def of_file(cls, path: Path) -> dict[str, str]:
        """The data and the format of a file, by its name. Raises InvalidArgument, OSError."""
        file_format = next((one for one in cls.formats if path.name.lower().endswith(f".{one}")), None)
        if file_format is None:
            endings = ", ".join(f".{one}" for one in cls.formats)
            raise InvalidArgument(f"{path} must end in one of {endings}", field="file")
        return {"data": base64.b64encode(path.read_bytes()).decode("ascii"), "format": file_format}


@dataclass(frozen=True)
class MeshShape(OfFile, Shape):
    """The inside of a closed surface of triangles."""

    data: str = described("A file of the mesh in base64, in mm of the scene's frame.")
    format: str = described("Of the file.", "stl", choices=MESH_FORMATS)
    kind: Literal["mesh"] = kind_field("mesh")
    formats = MESH_FORMATS

    @cached_property
    def _surface(self) -> tuple[Any, FloatArray, FloatArray]:  # k-d tree, [S, 3] points, [S, 3] normals
        """Points of the surface, as many by area everywhere, and the corners of its triangles."""
        import cv2

        try:
            import trimesh
        except ImportError as error:
            raise missing_extra(error, "reading meshes", field="data") from error
        try:
            mesh: Any = trimesh.load(io.BytesIO(self.content()), file_type=self.format, force="mesh")
            is_closed = bool(mesh.is_watertight)
        except InvalidArgument:
            raise
        except Exception as error:  # it raises whatever the reading of a damaged file meets
            raise InvalidArgument(f"data cannot be read as {self.format}: {error}", field="data") from None
        if not is_closed or len(mesh.faces) > MAX_FACES:
            raise InvalidArgument(
                f"data must be a closed surface of at most {MAX_FACES:,} triangles, got "
                f"{'an open' if not is_closed else 'a closed'} one of {len(mesh.faces):,}",
                field="data",
            )
        mesh.fix_normals()
        points, faces = trimesh.sample.sample_surface(mesh, SURFACE_POINTS, seed=0)
        normals = np.asarray(mesh.face_normals)[faces]
        points = np.concatenate([points, mesh.vertices])
        normals = np.concatenate([normals, mesh.vertex_normals])
        index = cv2.flann.Index(points.astype(np.float32), {"algorithm": 4, "leaf_max_size": 16})
        return index, np.asarray(points, np.float64), np.asarray(normals, np.float64)

    def distance_mm(self, points: FloatArray) -> FloatArray:
        """From the plane of the surface at its nearest point; the sign is the plane's."""
        index, surface, normals = self._surface
        indices, _ = index.knnSearch(np.ascontiguousarray(points, np.float32), 1, params={"checks": -1})
        nearest = indices[:, 0]
        away = points - surface[nearest]
        across = (away * normals[nearest]).sum(axis=1)
        far = np.linalg.norm(away, axis=1)
        distance: FloatArray = np.where(far > 1.0, np.copysign(far, across), across)
        return distance

    def bounds_mm(self) -> tuple[FloatArray, FloatArray]:
        _, surface, _ = self._surface
        return surface.min(axis=0), surface.max(axis=0)


@dataclass(frozen=True)
class MapShape(OfFile, Shape):
    """The voxels of a label in a label map. It can be cut out and relabelled, not inserted."""

    data: str = described("A NIfTI-1 or NRRD file in base64, in mm of the scene's frame (RAS+).")
    format: str = described("Of the file.", "nii.gz", choices=MAP_FORMATS)
    label: int = described("Of the voxels; 0: of all that have one.", 0, low=0, high=255)
    kind: Literal["map"] = kind_field("map")
    formats = MAP_FORMATS
    has_surface = False

    @cached_property
    def _map(self) -> tuple[Any, FloatArray]:
        from ultragray.scene.label_maps import read_label_map

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, f"map.{self.format}")
            path.write_bytes(self.content())
            volume, affine = read_label_map(path)
        to_voxels = np.asarray(np.linalg.inv(affine), np.float64)
        return (volume == self.label if self.label else volume > 0), to_voxels

    def distance_mm(self, points: FloatArray) -> FloatArray:
        """-1 inside, 1 outside."""
        inside, to_voxels = self._map
        places = np.rint(points @ to_voxels[:3, :3].T + to_voxels[:3, 3]).astype(np.int64)
        known = ((places >= 0) & (places < inside.shape)).all(axis=1)
        distances = np.ones(len(points))
        distances[known] = np.where(inside[tuple(places[known].T)], -1.0, 1.0)
        return distances

    def bounds_mm(self) -> tuple[FloatArray, FloatArray]:
        inside, to_voxels = self._map
        corners = np.argwhere(np.ones((2, 2, 2))) * np.array(inside.shape) - 0.5
        to_mm = np.linalg.inv(to_voxels)
        places = corners @ to_mm[:3, :3].T + to_mm[:3, 3]
        return places.min(axis=0), places.max(axis=0)


@dataclass(frozen=True)
class LabelShape(Shape):
    """The Gaussians of the scene that have a label. It can be cut out and relabelled, not inserted."""

    name: str = described("Of the label, as the scene names it.")
    kind: Literal["label"] = kind_field("label")
    has_surface = is_in_space = False


def read_document(path: Path, field: str) -> Any:
    """A JSON file, or a TOML one, in which `file`, a path beside it, has become the data of its shape.

    Raises InvalidArgument, OSError.
    """
    try:
        if path.stat().st_size > MAX_DOCUMENT_BYTES:
            raise ValueError(f"it is larger than {MAX_DOCUMENT_BYTES >> 20} MiB")
        text = path.read_text(encoding="utf-8")
        document: Any = tomllib.loads(text) if path.suffix == ".toml" else json.loads(text)
    except (OSError, ValueError, RecursionError) as error:
        raise InvalidArgument(f"{path} cannot be read as {field}: {error}", field=field) from None
    return _with_files(document, path.parent)


def _with_files(document: Any, folder: Path) -> Any:
    if isinstance(document, Sequence) and not isinstance(document, str):
        return [_with_files(one, folder) for one in document]
    if not isinstance(document, dict):
        return document
    inner = {name: _with_files(value, folder) for name, value in document.items()}
    if "file" not in inner:
        return inner
    of_kind: Any = Shape.member(inner.get("kind"))
    if not issubclass(of_kind, OfFile):
        raise InvalidArgument(f"file is for shapes of the kinds mesh and map, got {inner['kind']}", field="file")
    return inner | of_kind.of_file(folder / str(inner.pop("file")))

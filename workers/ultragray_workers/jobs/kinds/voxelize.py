"""Voxelization: a field of a scene is sampled on a grid and becomes a volume."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from ultragray.contract import described, kind_field
from ultragray.rendering.volumes import (
    SMALLEST_SPACING_MM,
    VOLUME_FIELDS,
    VOLUME_SUFFIXES,
    VolumeGrid,
    check_field,
    parse_box,
    voxel_bytes,
)
from ultragray.scene.info import SceneInfo
from ultragray_workers.errors import StorageFull
from ultragray_workers.jobs.kinds.base import Specification, Surroundings

_MB = 1e6
_FORMATS = tuple(suffix[1:] for suffix in VOLUME_SUFFIXES)


@dataclass(frozen=True)
class VoxelizeJob(Specification):
    """A field of a scene becomes a volume, such as echo.nii.gz; no probe is involved.

    volume.json says where its voxels lie. Raises InvalidArgument.
    """

    scene: str = described("Name of a scene; NAME@SHA256, or NAME@ and 12 digits of it: with that content alone.")
    field: str = described("At each point. attenuation: per mm.", "echo", choices=VOLUME_FIELDS)
    spacing_mm: float = described("Distance of two voxels along each axis.", 0.5, low=SMALLEST_SPACING_MM, high=1000.0)
    box_mm: str | None = described(
        "Ranges of x, y and z in the scene's frame, such as -20:20,0:30,-5:45. Default: the bounds of the Gaussians.",
        None,
    )
    format: str = described("Of the file.", _FORMATS[0], choices=_FORMATS)
    kind: Literal["voxelize"] = kind_field("voxelize")

    run_module = "ultragray_workers.jobs.kinds.voxelize_run"
    needs_scene = "scene"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.box_mm is not None:
            VolumeGrid.over_box(*parse_box(self.box_mm), self.spacing_mm)

    @property
    def file_name(self) -> str:
        return f"{self.field}.{self.format}"

    def grid(self, info: SceneInfo) -> VolumeGrid:
        return VolumeGrid.over_scene(info, self.box_mm, self.spacing_mm)

    def check(self, surroundings: Surroundings) -> None:
        """Raises InvalidArgument for labels of a scene without them and for too many voxels; StorageFull for more than
        the disk has room for."""
        scene, free = surroundings.scene, surroundings.free_bytes
        assert scene is not None
        check_field(self.field, has_labels=bool(scene.info.label_names))
        needed = math.prod(self.grid(scene.info).shape) * voxel_bytes(self.field)
        if free is not None and needed > free:
            raise StorageFull(
                f"the volume takes up to {needed / _MB:,.0f} MB, the artifact folder has {free / _MB:,.0f} MB left",
                field="spacing_mm",
            )

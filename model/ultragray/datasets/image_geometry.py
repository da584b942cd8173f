"""The geometry of images that say their probe: in a recording of ROS 2, or in a file of our own exporter."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ultragray.contract import Contract, described, from_dict
from ultragray.datasets.fan import FanGeometry, FanLines
from ultragray.datasets.images import parse_crop, poses_from_image_transforms, region_of
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.geometry.probe import Fan, FloatArray, Picture, Probe
from ultragray.learn.sweep import ByteArray, ImageRegion, IntArray, Sweep

SAME = 1e-6  # relative, of the places of pixels


@dataclass(frozen=True)
class PixelGrid(Contract):
    """The `picture` of a geometry: the place of pixel (0, 0), and the way to the next one."""

    column_unit: str = described("mm along x, or deg from the axis of a fan.", choices=("mm", "deg"))
    first_column: float = described("Of the first column.")
    first_row_mm: float = described("Of the first row.")
    column_step: float = described("To the next column; negative where left and right are exchanged.")
    row_step_mm: float = described("To the next row.", above=0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.column_step == 0.0:
            raise InvalidArgument("column_step must not be 0", field="column_step")


@dataclass(frozen=True)
class ImageGeometry:
    """A probe and the grid of the pixels; None: they are the probe's own scan lines, from its near to its far."""

    probe: Probe
    grid: PixelGrid | None

    def sweep(
        self,
        images: ByteArray,  # [F, rows, columns]
        poses: FloatArray,  # [F, 4, 4] mm
        numbers: IntArray,
        path: Path,
        notes: tuple[str, ...],
        crop: str | None,
        times_s: FloatArray | None = None,  # [F]
    ) -> Sweep:
        """The frames as scan lines. Raises InvalidArgument for a crop of what is not in mm, DatasetInvalid."""
        size = images.shape[1], images.shape[2]
        probe, picture = self.probe, self._picture(size)
        if picture.step[0] < 0.0:
            images, picture = images[:, :, ::-1], picture.flipped()
        shown = self._as_lines(picture, path)
        if shown is not None and crop is None:
            frames = np.ascontiguousarray(images)
            return Sweep.of_recording(frames, poses, shown, numbers, str(path), notes, times_s=times_s)
        pixel_mm, image_to_probe = picture.step, _pixel_to_probe(picture)
        if picture.column_unit == "mm" and probe.is_true_to_scale:
            box = parse_crop(crop, *size)
            poses, probe = poses_from_image_transforms(poses @ image_to_probe, box, numbers, path)
            images = images[:, box.top : box.bottom, box.left : box.right]
        elif crop is not None:
            raise InvalidArgument(f"crop is for the images of linear probes, these are of {probe}", field="crop")
        elif picture.column_unit == "mm" and isinstance(probe, Fan):
            lines = FanLines(_fan_on_screen(probe, picture), size, pixel_mm)
            images, box = lines.frames(images), lines.box
            probe = _fan_on_screen(probe, picture).probe()
        else:
            raise DatasetInvalid(
                f"{path}: its images cannot be brought back to the scan lines of {probe}: record them without "
                "pixel_mm, or export them as mcap"
            )
        region: ImageRegion = region_of(size, box, pixel_mm, image_to_probe)
        frames = np.ascontiguousarray(images)
        return Sweep.of_recording(frames, poses, probe, numbers, str(path), notes, times_s=times_s, region=region)

    def _picture(self, size: tuple[int, int]) -> Picture:
        if self.grid is None:
            return self.probe.frame_picture(*size)
        first, step = (self.grid.first_column, self.grid.first_row_mm), (self.grid.column_step, self.grid.row_step_mm)
        return Picture(*size, self.grid.column_unit, first, step)

    def _as_lines(self, picture: Picture, path: Path) -> Probe | None:
        """The probe whose own scan lines the pixels are; it may end before `far_mm`. None: they are others."""
        far_mm = picture.first[1] + (picture.height - 0.5) * picture.step[1]
        try:
            shown = self.probe if far_mm > self.probe.far_mm * (1 - SAME) else self.probe.ending_at(far_mm)
        except InvalidArgument as error:
            raise DatasetInvalid(f"{path}: its geometry cannot be: {error}") from error
        own = shown.frame_picture(picture.height, picture.width)
        places = np.array([own.first, own.step]), np.array([picture.first, picture.step])
        is_own = own.column_unit == picture.column_unit and np.allclose(*places, rtol=SAME, atol=SAME)
        return shown if is_own else None


def _pixel_to_probe(picture: Picture) -> FloatArray:  # [4, 4] mm
    return np.array(
        [
            [picture.step[0], 0.0, 0.0, picture.first[0]],
            [0.0, 0.0, -1.0, 0.0],
            [0.0, picture.step[1], 0.0, picture.first[1]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _fan_on_screen(probe: Fan, picture: Picture) -> FanGeometry:
    bottom_mm = picture.first[1] + (picture.height - 0.5) * picture.step[1]
    far_mm = probe.far_mm if bottom_mm > probe.far_mm * (1 - SAME) else bottom_mm
    half_deg = probe.opening_angle_deg / 2
    apex_column, apex_row = (-first / step for first, step in zip(picture.first, picture.step, strict=True))
    return FanGeometry(-half_deg, half_deg, probe.near_mm, far_mm, apex_column, apex_row)


def read_geometry(text: str | bytes, where: str) -> ImageGeometry:
    """The geometry of a JSON document. Raises DatasetInvalid, naming `where`."""
    try:
        document: Any = json.loads(text)
        if not isinstance(document, dict) or "probe" not in document:
            raise ValueError("it must be an object with a probe")
        picture = document.get("picture")
        probe = from_dict(Probe, document["probe"])
        return ImageGeometry(probe, None if picture is None else from_dict(PixelGrid, picture))
    except (ValueError, RecursionError) as error:
        raise DatasetInvalid(f"{where}: the geometry of its images cannot be read: {error}") from error

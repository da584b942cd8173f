"""Facts of a dataset that a training needs: its size, the spacing of its frames and pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ultragray.datasets.sweep import Dataset, Sweep, corner_distances_mm
from ultragray.probe import FloatArray
from ultragray.training.data.sampling import out_of_plane_range_mm

SCALE_MARGIN = 1.1  # of the released recipe
FRAMES_AT_ONCE = 64
LEAST_RANGE = 1.5  # of the shift out of the plane, × the spacing of the frames
PIXELS_PER_GAUSSIAN = 25
STEPS_PER_FRAME = 15  # a frame that is seen more often is learned with its noise
MIN_STEPS, MAX_STEPS = 250, 1_500  # fewer leave shadows unlearned
MIN_GAUSSIANS, MAX_GAUSSIANS = 2_000, 150_000  # fewer hold no anatomy, more take longer than they are worth


@dataclass(frozen=True)
class Geometry:
    """Values that follow from the data where a training's settings leave them open.

    The scene scale is 1.1 × the largest distance of a corner of a training image from the centre.
    """

    centre_mm: FloatArray  # [3]
    scene_scale_cm: float
    frame_spacing_mm: float
    pixel_mm: float  # geometric mean of the axial and the lateral size
    out_of_plane_mm: float  # full range of the shift of a batch along elevation that the frames tell of; 0: they do not
    pixel_count: int  # of all training frames
    frame_count: int

    @classmethod
    def of(cls, dataset: Dataset) -> Geometry:
        sweep, centre = dataset.train, dataset.centre_mm
        reach_mm = float(np.linalg.norm(sweep.corners_mm() - centre, axis=-1).max())
        axial, lateral = sweep.pixel_mm
        spacing = frame_spacing_mm(sweep)
        return cls(
            centre_mm=centre,
            scene_scale_cm=SCALE_MARGIN * reach_mm / 10.0,
            frame_spacing_mm=spacing,
            pixel_mm=(axial * lateral) ** 0.5,
            out_of_plane_mm=out_of_plane_range_mm(sweep),
            pixel_count=sweep.images.size,
            frame_count=len(sweep),
        )

    def gaussian_count(self, views_between: float) -> int:
        """By the pixels of the frames, twice as many where what lies between them is learned too."""
        count = _times(views_between) * self.pixel_count // PIXELS_PER_GAUSSIAN
        return min(max(count, MIN_GAUSSIANS), MAX_GAUSSIANS)

    def steps(self, views_between: float) -> int:
        """By the frames, likewise."""
        times = _times(views_between)
        return min(max(times * STEPS_PER_FRAME * self.frame_count, times * MIN_STEPS), MAX_STEPS)

    def least_out_of_plane_mm(self, views_between: float) -> float:
        """Range of the shift that leaves no gap between frames, where no views between them fill it."""
        return 0.0 if views_between else LEAST_RANGE * self.frame_spacing_mm

    @property
    def initial_scale_mm(self) -> float:
        """Standard deviation in the image plane at the start: half a frame spacing, and no less than a pixel."""
        return max(0.5 * self.frame_spacing_mm, self.pixel_mm)

    def initial_elevation_mm(self, out_of_plane_mm: float) -> float:
        """Standard deviation across the image plane at the start: as thick as the slice that is learned."""
        return max(self.frame_spacing_mm, out_of_plane_mm / 2.0, self.pixel_mm)


def _times(views_between: float) -> int:
    return 2 if views_between else 1


def frame_spacing_mm(sweep: Sweep) -> float:
    """Median over the frames of the distance to the nearest other frame, along the elevation axis.

    Nearest by the mean distance of corresponding image corners; the distance is the mean over the corners of what of
    it lies across the image plane. 0 for a probe that was held still.
    """
    corners, elevations = sweep.corners_mm(), sweep.poses[:, :3, 1]  # [F, K, 3], [F, 3]
    count = len(corners)
    gaps: list[float] = []
    for start in range(0, count, FRAMES_AT_ONCE):
        some = np.arange(start, min(start + FRAMES_AT_ONCE, count))
        travel = corner_distances_mm(corners[some, None], corners)  # [f, F]
        travel[some - start, some] = np.inf
        offsets = corners[travel.argmin(axis=1)] - corners[some]  # [f, K, 3]
        gaps.extend(np.abs(np.einsum("fkc,fc->fk", offsets, elevations[some])).mean(axis=1).tolist())
    return float(np.median(gaps))

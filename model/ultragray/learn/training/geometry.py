"""What the frames tell before the first step: spacing, size of a pixel, batches, and pixels that lie in a shadow."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ultragray.geometry.probe import FloatArray
from ultragray.geometry.scan_conversion import interpolated_sharply
from ultragray.learn.prediction import seen_by_frame
from ultragray.learn.sweep import Dataset, IntArray, Sweep, corner_distances_mm, spread_places
from ultragray.learn.training.between import neighbours_of

TELLING_NEIGHBOURS = 8  # with fewer, PSNR only says that speckle averages out
MAX_SLICE_MM = 8.0  # no probe's slice is thicker
RANGES = (1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 11.0, 16.0, 23.0, 32.0)  # × the distance of neighbouring frames
PREDICTED_FRAMES, PREDICTED_PIXELS = 256, 4096  # enough to tell one range from another


class BatchSampler:
    """Goes through the frames in a new random order again and again, a batch at a time."""

    def __init__(self, frame_count: int, batch_size: int, generator: torch.Generator) -> None:
        self.batch_size = min(batch_size, frame_count)
        self.generator = generator
        self.waiting = torch.zeros(0, dtype=torch.int64)  # frames of this round that were not seen yet
        self._frame_count = frame_count

    def next_batch(self) -> Tensor:  # [b]
        while len(self.waiting) < self.batch_size:
            order = torch.randperm(self._frame_count, generator=self.generator)
            self.waiting = torch.cat([self.waiting, order])
        batch, self.waiting = self.waiting[: self.batch_size], self.waiting[self.batch_size :]
        return batch


def out_of_plane_range_mm(sweep: Sweep) -> float:
    """The blur of a slice along elevation that the frames themselves show, as the full range of the shift.

    Each frame is predicted by its neighbours within ± half a range, with the weights that the shift is drawn with.
    Half the range with the best mean PSNR is taken (PSNR likes blur; the half has most of the gain and keeps detail),
    at most MAX_SLICE_MM, if the median frame has eight others or more within ± half that range: among fewer the mean of
    all wins, however far apart they are. Else 0.
    """
    corners = sweep.corners_mm()  # [F, K, 3]
    distances = np.stack([corner_distances_mm(own, corners) for own in corners])  # [F, F]
    np.fill_diagonal(distances, np.inf)
    step_mm = float(np.median(distances.min(axis=1)))
    if step_mm == 0.0:
        return 0.0
    pixels = sweep.images.reshape(len(sweep), -1)
    stride = max(1, pixels.shape[1] // PREDICTED_PIXELS) | 1  # odd: it must not fall into step with the columns
    images = torch.from_numpy(pixels[:, ::stride].astype(np.float32)) / 255.0  # [F, P]
    targets = spread_places(len(sweep), PREDICTED_FRAMES)
    ranges_mm = [factor * step_mm for factor in RANGES]
    scores = [_psnr_from_neighbours(images, distances[targets], targets, range_mm) for range_mm in ranges_mm]
    best_mm = ranges_mm[int(np.argmax(scores))]
    neighbours = float(np.median((distances[targets] < best_mm / 2).sum(axis=1)))
    return min(0.5 * best_mm, MAX_SLICE_MM) if neighbours >= TELLING_NEIGHBOURS else 0.0


def _psnr_from_neighbours(images: Tensor, distances: FloatArray, targets: IntArray, range_mm: float) -> float:
    """Mean PSNR, dB, of frames `targets` [T] predicted by those within half a range; by the nearest where none is."""
    weights = np.where(distances < range_mm / 2, np.cos(np.pi * np.minimum(distances, range_mm) / range_mm) ** 2, 0.0)
    alone = weights.sum(axis=1) < 1e-6
    weights[alone, distances[alone].argmin(axis=1)] = 1.0
    shares = torch.from_numpy(weights / weights.sum(axis=1, keepdims=True)).float()
    errors = (shares @ images - images[torch.from_numpy(targets)]).square().mean(dim=1)
    return float((-10.0 * (errors + 1e-9).log10()).mean())


def out_of_plane_shift_mm(range_mm: float, generator: torch.Generator) -> float:
    """x·range with x in [−½, ½], drawn uniformly and accepted with probability cos²(πx)."""
    while True:
        x, threshold = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
        if threshold <= math.cos(math.pi * (x - 0.5)) ** 2:
            return float((x - 0.5) * range_mm)


def shift_out_of_plane(poses: FloatArray, shift_mm: float) -> FloatArray:  # [C, 4, 4] mm -> [C, 4, 4] mm
    shifted = poses.copy()
    shifted[:, :3, 3] += shift_mm * poses[:, :3, 1]
    return shifted


SCALE_MARGIN = 1.1  # of the released recipe
FRAMES_AT_ONCE = 64
LEAST_RANGE = 1.5  # of the shift out of the plane, × the spacing of the frames
PIXELS_PER_GAUSSIAN, LEAST_PIXELS = 25, 12  # the latter, of distinct ones, where neighbours share their detail
DIFFERENT_DETAIL, SAME_DETAIL = 0.25, 0.5  # correlation of that of neighbours, up to which and from which on
STEPS_PER_FRAME = 15  # a frame that is seen more often is learned with its noise
MIN_STEPS, USUAL_STEPS = 250, 1_500  # fewer leave shadows unlearned
MIN_GAUSSIANS, USUAL_GAUSSIANS = 2_000, 150_000  # fewer hold no anatomy; enough unless much more is to be seen
MAX_GAUSSIANS = 600_000  # of a large volume that is seen finely
LEAST_LIT = 8  # grey value, of 255, of a pixel that shows something


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
    distinct_pixels: int  # of those, lit ones, and in frames that overlap along elevation each place once
    shared_detail: float  # as `shared_detail` has it
    frame_count: int

    @classmethod
    def of(cls, dataset: Dataset) -> Geometry:
        sweep, centre = dataset.train, dataset.centre_mm
        reach_mm = float(np.linalg.norm(sweep.corners_mm() - centre, axis=-1).max())
        axial, lateral = sweep.pixel_mm
        spacing, range_mm = frame_spacing_mm(sweep), out_of_plane_range_mm(sweep)
        distinct = min(1.0, spacing / max(range_mm / 2.0, 1e-9))
        return cls(
            centre_mm=centre,
            scene_scale_cm=SCALE_MARGIN * reach_mm / 10.0,
            frame_spacing_mm=spacing,
            pixel_mm=(axial * lateral) ** 0.5,
            out_of_plane_mm=range_mm,
            pixel_count=sweep.images.size,
            distinct_pixels=int(distinct * np.count_nonzero(sweep.images >= LEAST_LIT)),
            shared_detail=shared_detail(sweep),
            frame_count=len(sweep),
        )

    def gaussian_count(self, views_between: float) -> int:
        """By the pixels of the frames, twice as many where what lies between them is learned too.

        More than USUAL_GAUSSIANS only as distinct pixels ask for: those of large volumes that are seen finely. Of these
        a Gaussian has LEAST_PIXELS where neighbouring frames share their detail: it is tissue, and lies between them,
        too. Detail that the next frame does not show is noise for it, and Gaussians that hold it show noise there.
        """
        times = _times(views_between)
        usual = min(self._usual_gaussians(views_between), USUAL_GAUSSIANS)
        detail = DIFFERENT_DETAIL, SAME_DETAIL
        pixels = float(np.interp(self.shared_detail, detail, (PIXELS_PER_GAUSSIAN, LEAST_PIXELS)))
        return max(usual, min(int(times / pixels * self.distinct_pixels), MAX_GAUSSIANS), MIN_GAUSSIANS)

    def steps(self, views_between: float) -> int:
        """By the frames, likewise; more than USUAL_STEPS as the square root of the Gaussians that are more.

        Fewer likewise, down to a half, where there are fewer Gaussians than the pixels would have: each is the mean of
        what many pixels show, and a step tells it more.
        """
        times, count = _times(views_between), max(self.gaussian_count(views_between), USUAL_GAUSSIANS)
        by_pixels = max(count, min(self._usual_gaussians(views_between), MAX_GAUSSIANS))
        most = USUAL_STEPS * count / math.sqrt(USUAL_GAUSSIANS * by_pixels)
        return min(max(times * STEPS_PER_FRAME * self.frame_count, times * MIN_STEPS), round(most))

    def _usual_gaussians(self, views_between: float) -> int:
        """As many as all pixels would have, without a limit."""
        return int(_times(views_between) / PIXELS_PER_GAUSSIAN * self.pixel_count)

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


COMPARED_PAIRS, COMPARED_PIXELS = 32, 4096  # of neighbours, of each: by which of them, ρ changes by up to 0.04
DETAIL_PIXELS = 1.0  # standard deviation of the Gaussian beyond which structure is no detail


def shared_detail(sweep: Sweep) -> float:
    """The mean correlation of the detail of neighbouring frames; 0 where no frame has a neighbour.

    Detail is what an image loses when it is smoothed by a pixel. Pixels of a frame are projected onto the plane of the
    other along its normal; what lies beside it does not count, nor do frames without detail.
    """
    pairs, correlations = neighbours_of(sweep).pairs, []
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    for first, second in pairs[spread_places(len(pairs), COMPARED_PAIRS)]:
        random = np.random.default_rng(first)
        rows, columns = (random.integers(size, size=COMPARED_PIXELS) for size in (sweep.height, sweep.width))
        local = sweep.probe.points_mm((rows + 0.5) / sweep.height, (columns + 0.5) / sweep.width)
        onto = np.linalg.inv(sweep.poses[second]) @ sweep.poses[first]
        inside, there = seen_by_frame(sweep, second, local @ onto[:3, :3].T + onto[:3, 3], _interpolated_detail)
        here = _interpolated_detail(sweep.images, first, rows[inside], columns[inside])
        if len(here) and here.std() * there.std() > 0.0:
            correlations.append(float(np.corrcoef(here, there)[0, 1]))
    return float(np.mean(correlations)) if correlations else 0.0


def _interpolated_detail(
    frames: npt.NDArray[np.uint8], which: IntArray | int, rows: npt.NDArray[Any], columns: npt.NDArray[Any]
) -> FloatArray:  # [F, H, W], [P] each -> [P]
    image = frames[which].astype(np.float32)
    detail = image - cv2.GaussianBlur(image, (0, 0), DETAIL_PIXELS, borderType=cv2.BORDER_REPLICATE)
    return interpolated_sharply(detail[None], 0, rows, columns)


# The shadows that training frames show: the evidence for what absorbs.
#
# Darkness can be tissue without echo or a beam that has been spent. A shadow lies below something that reflects, and
# it lasts to the end of the scan line, while other lines show echoes at these depths. So the share of the beam that
# is left is at most what the brightest place from here down reaches of what is usual at its depth. Where a whole
# depth is dark in every frame, and along lines that are dark from the face on, which have no contact, there is no
# evidence, and the share is 1.

USUAL = 0.7  # quantile over all scan lines at a depth: brighter than most shadows, less than a reflector
LEAST_USUAL = 0.03  # grey value, of 1, below which a depth tells nothing
SMOOTHING_MM = 0.7, 1.0  # standard deviation across the scan lines and along them: speckle is no evidence
LEAST_LENGTH_MM, LEAST_LENGTH = 5.0, 0.1  # of a shadow; the latter of the scan line
FACE_MM = 1.0  # within which a line in contact is bright
NO_CONTACT = 0.05  # of the usual brightness: a scan line that nowhere has more shows nothing at all
SHADOWED = 0.9  # of the beam left, or less
SPENT = 0.2  # of the beam left, below which noise outweighs the echo

LOOKED_AT_FRAMES = 64  # for what is usual

FloatImage = npt.NDArray[np.float32]


class Beam(NamedTuple):
    """The evidence of one frame."""

    share: FloatImage  # [H, W] share of the beam, at most
    echo: FloatImage  # [H, W] the smoothed brightness that the whole beam would have shown there

    @property
    def is_shadowed(self) -> npt.NDArray[np.bool_]:  # [H, W]
        return self.share < SHADOWED


class Shadows:
    """The evidence in the frames of a sweep, frame by frame."""

    def __init__(self, sweep: Sweep) -> None:
        self._sweep = sweep
        self._axial, self._lateral = sweep.pixel_mm
        some = np.stack([self._smooth(place) for place in spread_places(len(sweep), LOOKED_AT_FRAMES)])
        self._usual = _usual_by_depth(some)  # [H] brightness
        (self._bright_rows,) = np.nonzero(self._usual > LEAST_USUAL)
        self._usual_below = _usual_by_depth(self._brightest_below(self._relative(some)))  # [H]

    def seen_in(self, sweep: Sweep) -> Shadows:
        """The evidence in other frames of the same recording, by what is usual in those looked at."""
        other = copy(self)
        other._sweep = sweep
        return other

    def of(self, place: int) -> Beam:
        height, width = self._sweep.height, self._sweep.width
        if not len(self._bright_rows):
            return Beam(np.ones((height, width), np.float32), np.zeros((height, width), np.float32))
        relative = self._relative(self._smooth(place)[None])
        below = self._brightest_below(relative)[0] / np.maximum(self._usual_below, 1e-6)[:, None]
        last = max(0, int(self._bright_rows[-1] - max(LEAST_LENGTH_MM / self._axial, LEAST_LENGTH * height)))
        below[last:] = below[last]  # too little is left of the line to tell
        at_face = below[: max(1, round(FACE_MM / self._axial))].max(axis=0)
        share = np.clip(below / np.maximum(at_face, NO_CONTACT), 0.0, 1.0)
        share[:, at_face < NO_CONTACT] = 1.0
        echo = np.where(share < SPENT, 1.0, np.minimum(relative[0] / np.maximum(share, SPENT), 1.0))
        return Beam(share, (self._usual[:, None] * echo).astype(np.float32))

    def pixels(self) -> npt.NDArray[np.bool_]:  # [F, H, W]
        shadows = np.empty(self._sweep.images.shape, bool)
        for place, pixels in enumerate(shadows):
            pixels[:] = self.of(place).is_shadowed
        return shadows

    def _smooth(self, place: int) -> FloatImage:  # [H, W]
        sigmas = [max(0.5, mm / pixel) for mm, pixel in zip(SMOOTHING_MM, (self._lateral, self._axial), strict=True)]
        image = self._sweep.images[place] / np.float32(255.0)
        smooth: FloatImage = cv2.GaussianBlur(
            image, (0, 0), sigmas[0], sigmaY=sigmas[1], borderType=cv2.BORDER_REPLICATE
        )
        return smooth

    def _relative(self, smooth: FloatImage) -> FloatImage:  # [F, H, W] both
        """Brightness over what is usual at its depth; 0 where the depth tells nothing."""
        relative = np.zeros_like(smooth)
        relative[:, self._bright_rows] = smooth[:, self._bright_rows] / self._usual[self._bright_rows, None]
        return relative

    @staticmethod
    def _brightest_below(relative: FloatImage) -> FloatImage:  # [F, H, W] both
        """The largest value from each pixel down its scan line."""
        return np.maximum.accumulate(relative[:, ::-1], axis=1)[:, ::-1].copy()


def _usual_by_depth(images: FloatImage) -> FloatImage:  # [F, H, W] -> [H]
    return np.quantile(images, USUAL, axis=(0, 2)).astype(np.float32)

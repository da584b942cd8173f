"""The texture of rendered frames against that of the true ones: contrast and size of speckle, histogram of grey values.

A mean over many looks can reach the best PSNR and yet look like no scanner's image: these figures show it.

- Windows: the true frame is tiled with WINDOW_PIXELS². Tiles with more than STRAY_SHARE of black or saturated pixels
  are left out; the CALM_SHARE of the others whose quarters differ least in their mean, relative to the tile's own
  mean, are taken as homogeneous tissue. The rendered frame is measured in the same windows.
- Envelope: frames are compressed logarithmically, and a ratio such as std/mean makes sense for amplitudes only. So
  grey values g are taken back to 10^(R·(g − 1)/20) with R = 60 dB, the range that the display assumes too. The range of
  the scanner is not known: where it is another, contrasts are not absolute, yet truth and rendering can be compared.
- contrast: std/mean of the envelope in a window, a mean over the windows. Fully developed speckle has 0.52, its calmest
  windows a little less.
- axial_mm, lateral_mm: full width at half maximum of the envelope's autocorrelation along rows of depth and across scan
  lines, the mean of each window taken away, from covariances averaged over the windows; pixels become mm by the mean
  distance of rows, or of scan lines, in these windows. At most a window wide; speckle of a third of a window looks a
  sixth narrower than it is, in both frames alike.
- axial_gradient, lateral_gradient: mean difference of grey values from row to row, and from scan line to scan line,
  all pixels.
- histogram_distance: 1-Wasserstein distance between the grey values of the two frames, all pixels, in [0, 1].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ultragray.geometry.probe import FloatArray, Probe
from ultragray.rendering.display import FRAME_RANGE_DB

WINDOW_PIXELS = 16
BLACK, SATURATED = 0.02, 0.98
STRAY_SHARE = 0.02
CALM_SHARE = 0.25
MAX_LAG = WINDOW_PIXELS // 2

FrameArray = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Speckle:
    """The speckle of one picture's homogeneous windows, or a mean over several pictures."""

    contrast: float
    axial_mm: float
    lateral_mm: float
    axial_gradient: float
    lateral_gradient: float


@dataclass(frozen=True)
class FrameSpeckle:
    """A true and a rendered frame compared. None: the true frame has no homogeneous window."""

    true: Speckle | None
    rendered: Speckle | None
    histogram_distance: float


@dataclass(frozen=True)
class SpeckleSummary:
    """Means over the frames of a set. `frames` of them have homogeneous windows; with none, there is no speckle."""

    true: Speckle | None
    rendered: Speckle | None
    histogram_distance: float
    frames: int

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    def figures(self) -> dict[str, float]:
        """The numbers by name, such as speckle_contrast and true_speckle_contrast, without those that are not known."""
        named = {"": self.rendered, "true_": self.true}
        return {
            **{
                f"{prefix}speckle_{name}": value
                for prefix, speckle in named.items()
                if speckle is not None
                for name, value in asdict(speckle).items()
            },
            "histogram_distance": self.histogram_distance,
        }


def compare_speckle(rendered: FrameArray, truth: FrameArray, probe: Probe) -> list[FrameSpeckle]:  # [C, H, W] in [0, 1]
    tiles_mm = _pixels_mm(probe, *truth.shape[1:])
    comparisons = []
    for image, true in zip(rendered, truth, strict=True):
        calm = calmest(tiles_of(true))
        distance = float(np.abs(np.sort(image, axis=None) - np.sort(true, axis=None)).mean())
        of_image, of_true = (_speckle(frame, calm, tiles_mm[calm]) if len(calm) else None for frame in (image, true))
        comparisons.append(FrameSpeckle(of_true, of_image, distance))
    return comparisons


def summarize(frames: Sequence[FrameSpeckle]) -> SpeckleSummary:
    true = [frame.true for frame in frames if frame.true is not None]
    return SpeckleSummary(
        true=_mean(true),
        rendered=_mean([frame.rendered for frame in frames if frame.rendered is not None]),
        histogram_distance=float(np.mean([frame.histogram_distance for frame in frames])),
        frames=len(true),
    )


def _mean(several: Sequence[Speckle]) -> Speckle | None:
    return Speckle(*np.mean([astuple(one) for one in several], axis=0).tolist()) if several else None


def tiles_of(frame: FrameArray) -> FloatArray:  # [H, W] -> [T, WINDOW_PIXELS, WINDOW_PIXELS]
    rows, columns = (side // WINDOW_PIXELS for side in frame.shape)
    whole = frame[: rows * WINDOW_PIXELS, : columns * WINDOW_PIXELS].astype(np.float64)
    tiles = whole.reshape(rows, WINDOW_PIXELS, columns, WINDOW_PIXELS).swapaxes(1, 2)
    return tiles.reshape(-1, WINDOW_PIXELS, WINDOW_PIXELS)


def _pixels_mm(probe: Probe, height: int, width: int) -> FloatArray:  # [T, 2]
    """Distance of rows and of scan lines in the middle of each of `_tiles`."""
    rows = (np.arange(height // WINDOW_PIXELS) + 0.5) * WINDOW_PIXELS / height
    columns = (np.arange(width // WINDOW_PIXELS) + 0.5) * WINDOW_PIXELS / width
    row, column = (grid.ravel() for grid in np.meshgrid(rows, columns, indexing="ij"))
    half = 0.5 / width
    apart = probe.points_mm(row, column + half) - probe.points_mm(row, column - half)
    axial = np.full(len(row), probe.scan_line_length_mm / height)
    return np.stack([axial, np.linalg.norm(apart, axis=-1)], axis=1)


def calmest(tiles: FloatArray, share: float = CALM_SHARE) -> npt.NDArray[np.intp]:  # [T, n, n] -> places
    """A share of the tiles that are neither black nor saturated: the calmest."""
    stray = ((tiles < BLACK) | (tiles > SATURATED)).mean(axis=(1, 2))
    lit = np.flatnonzero(stray <= STRAY_SHARE)
    return lit[np.argsort(unrest(tiles[lit]), kind="stable")[: int(np.ceil(share * len(lit)))]]


def unrest(tiles: FloatArray) -> FloatArray:  # [T, n, n] -> [T]
    """How far the quarters of tiles that are not black differ in their mean, relative to it."""
    half = WINDOW_PIXELS // 2
    quarters = tiles.reshape(-1, 2, half, 2, half).mean(axis=(2, 4))
    differences: FloatArray = quarters.std(axis=(1, 2)) / np.maximum(quarters.mean(axis=(1, 2)), 1e-9)
    return differences


def _speckle(frame: FrameArray, calm: npt.NDArray[np.intp], pixels_mm: FloatArray) -> Speckle:  # [H, W], [T], [T, 2]
    envelope = 10.0 ** (FRAME_RANGE_DB / 20.0 * (tiles_of(frame)[calm] - 1.0))
    means = envelope.mean(axis=(1, 2))
    unit = envelope / means[:, None, None] - 1.0  # so that bright windows weigh no more than dark ones
    axial_mm, lateral_mm = pixels_mm.mean(axis=0)
    return Speckle(
        contrast=float(unit.std(axis=(1, 2)).mean()),
        axial_mm=_width_pixels(unit) * float(axial_mm),
        lateral_mm=_width_pixels(unit.swapaxes(1, 2)) * float(lateral_mm),
        axial_gradient=float(np.abs(np.diff(frame, axis=0)).mean()),
        lateral_gradient=float(np.abs(np.diff(frame, axis=1)).mean()),
    )


def _width_pixels(unit: FloatArray) -> float:  # [T, n, n] -> full width at half maximum along the second axis
    covariances = [(unit[:, lag:] * unit[:, : WINDOW_PIXELS - lag]).mean() for lag in range(MAX_LAG + 1)]
    half = 0.5 * covariances[0]
    for lag in range(MAX_LAG):
        if covariances[lag + 1] < half:
            return 2.0 * float(lag + (covariances[lag] - half) / (covariances[lag] - covariances[lag + 1]))
    return 2.0 * MAX_LAG


# How the texture at a place in space changes from frame to frame: the correlation of windows of two frames there.

PAIRED_ELEVATION_MM = 4.0
CALM_PAIRED_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class WindowPairs:
    """N windows of homogeneous tissue in one frame, each with the window at the same place in another one."""

    frames: npt.NDArray[np.intp]  # [N, 2]
    corners: npt.NDArray[np.intp]  # [N, 2, 2] row and column of the first pixel of both
    elevation_mm: FloatArray  # [N] between them, along elevation
    angle_deg: FloatArray  # [N] between the frames, but for the turn about the axial direction
    depth: FloatArray  # [N] from 0 to 1

    @classmethod
    def between(
        cls, images: FrameArray, poses: FloatArray, probe: Probe, pairs: npt.NDArray[np.intp]
    ) -> WindowPairs:  # [F, H, W] in [0, 1], [F, 4, 4] mm, [P, 2] frames
        """All of some pairs of frames whose place is within both and at most PAIRED_ELEVATION_MM from both."""
        height, width = images.shape[1:]
        rows, columns = height // WINDOW_PIXELS, width // WINDOW_PIXELS
        row, column = (grid.ravel() for grid in np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"))
        middle = WINDOW_PIXELS * (np.stack([row, column], axis=1) + 0.5)  # [T, 2]
        points = probe.points_mm(middle[:, 0] / height, middle[:, 1] / width)
        windows: list[tuple[FloatArray, ...]] = []
        for first, second in pairs:
            calm = calmest(tiles_of(images[first]), CALM_PAIRED_SHARE)
            there = np.linalg.inv(poses[second]) @ poses[first]
            local = points[calm] @ there[:3, :3].T + there[:3, 3]
            at = np.stack(probe.image_coordinates(local[:, 0], local[:, 2]), axis=1) * (height, width)
            corner = np.round(np.nan_to_num(at, nan=-1e6) - WINDOW_PIXELS / 2).astype(np.intp)
            fits = (corner >= 0).all(axis=1) & (corner <= (height - WINDOW_PIXELS, width - WINDOW_PIXELS)).all(axis=1)
            fits &= np.abs(local[:, 1]) <= PAIRED_ELEVATION_MM
            turn = np.degrees(np.arccos(np.clip(poses[first][:3, 2] @ poses[second][:3, 2], -1.0, 1.0)))
            count = int(fits.sum())
            own = (WINDOW_PIXELS * np.stack([row, column], axis=1))[calm][fits]
            windows.append(
                (
                    np.tile([first, second], (count, 1)),
                    np.stack([own, corner[fits]], axis=1),
                    np.abs(local[fits, 1]),
                    np.full(count, turn),
                    middle[calm][fits, 0] / height,
                )
            )
        frames, corners, elevation, angle, depth = (np.concatenate(parts) for parts in zip(*windows, strict=True))
        return cls(frames, corners, elevation, angle, depth)

    def select(self, chosen: npt.NDArray[np.bool_]) -> WindowPairs:
        return WindowPairs(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))

    def moments(self, images: FrameArray) -> FloatArray:  # [F, H, W] -> [N, 3]
        """Covariance of the grey values of each pair of windows, and both variances."""
        offset = np.arange(WINDOW_PIXELS)
        windows = [
            images[
                self.frames[:, one, None, None],
                self.corners[:, one, 0, None, None] + offset[:, None],
                self.corners[:, one, 1, None, None] + offset,
            ].astype(np.float64)
            for one in (0, 1)
        ]
        first, second = (some - some.mean(axis=(1, 2), keepdims=True) for some in windows)
        return np.stack([(a * b).mean(axis=(1, 2)) for a, b in ((first, second), (first, first), (second, second))], 1)


def correlation(moments: FloatArray) -> float:  # [N, 3]
    """That of all pixels of pairs of windows. NaN where there are none."""
    covariance, first, second = moments.sum(axis=0) if len(moments) else (np.nan,) * 3
    return float(covariance / np.sqrt(first * second))

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
    found = []
    for shown, true in zip(rendered, truth, strict=True):
        calm = _homogeneous(_tiles(true))
        distance = float(np.abs(np.sort(shown, axis=None) - np.sort(true, axis=None)).mean())
        of_shown, of_true = (
            _speckle(_tiles(frame)[calm], tiles_mm[calm]) if len(calm) else None for frame in (shown, true)
        )
        found.append(FrameSpeckle(of_true, of_shown, distance))
    return found


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


def _tiles(frame: FrameArray) -> FloatArray:  # [H, W] -> [T, WINDOW_PIXELS, WINDOW_PIXELS]
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


def _homogeneous(tiles: FloatArray) -> npt.NDArray[np.intp]:  # [T, n, n] -> places
    """The calmest of the tiles that are neither black nor saturated."""
    stray = ((tiles < BLACK) | (tiles > SATURATED)).mean(axis=(1, 2))
    lit = np.flatnonzero(stray <= STRAY_SHARE)
    half = WINDOW_PIXELS // 2
    quarters = tiles[lit].reshape(-1, 2, half, 2, half).mean(axis=(2, 4))
    unrest = quarters.std(axis=(1, 2)) / quarters.mean(axis=(1, 2))
    return lit[np.argsort(unrest, kind="stable")[: int(np.ceil(CALM_SHARE * len(lit)))]]


def _speckle(tiles: FloatArray, pixels_mm: FloatArray) -> Speckle:  # [T, n, n], [T, 2]
    envelope = 10.0 ** (FRAME_RANGE_DB / 20.0 * (tiles - 1.0))
    means = envelope.mean(axis=(1, 2))
    unit = envelope / means[:, None, None] - 1.0  # so that bright windows weigh no more than dark ones
    axial_mm, lateral_mm = pixels_mm.mean(axis=0)
    return Speckle(
        contrast=float(unit.std(axis=(1, 2)).mean()),
        axial_mm=_width_pixels(unit) * float(axial_mm),
        lateral_mm=_width_pixels(unit.swapaxes(1, 2)) * float(lateral_mm),
    )


def _width_pixels(unit: FloatArray) -> float:  # [T, n, n] -> full width at half maximum along the second axis
    covariances = [(unit[:, lag:] * unit[:, : WINDOW_PIXELS - lag]).mean() for lag in range(MAX_LAG + 1)]
    half = 0.5 * covariances[0]
    for lag in range(MAX_LAG):
        if covariances[lag + 1] < half:
            return 2.0 * float(lag + (covariances[lag] - half) / (covariances[lag] - covariances[lag + 1]))
    return 2.0 * MAX_LAG

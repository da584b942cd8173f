"""The image processing of this project beside scikit-image's: time of both, and how far their results are apart.

    python benchmarks/libraries.py

On one thread, on frames of the built-in phantom and on noise. docs/libraries.md says what follows.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from importlib.metadata import files
from typing import Any

import cv2
import numpy as np
import skimage
import torch
from skimage.filters import gaussian, prewitt_h, prewitt_v, threshold_li, threshold_otsu
from skimage.measure import block_reduce, label
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from skimage.transform import resize_local_mean, warp
from skimage.util import img_as_ubyte

from bone_shadow import BoneShadow
from figures import write
from ultragray import ConvexProbe
from ultragray.datasets.images import resize_frames
from ultragray.geometry.scan_conversion import interpolated, samples
from ultragray.learn.evaluation.metrics import frame_metrics, ms_ssim_scales
from ultragray.learn.sweep import Sweep
from ultragray.learn.training.geometry import Shadows
from ultragray.phantom.imaging import simulate
from ultragray.phantom.sweeps import PHANTOM_IMAGE_SIDE, PHANTOM_PROBE, freehand_poses
from ultragray.rendering.pixels import to_uint8
from ultragray_studies.bench.report import measured

CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=50.0, far_mm=150.0)
PIXEL_MM = 0.2
SIDE = 512
SMALL = 20  # pixels, of which MS-SSIM has one scale, and so is SSIM
FRAMES = 12
REPEATS = 30
IMPORTS = {  # and what is asked of each: scikit-image loads lazily
    "cv2": "resize",
    "skimage.metrics": "structural_similarity",
    "skimage.filters": "gaussian",
    "skimage.transform": "warp",
}

NEEDED = ("scikit-image", "scipy", "networkx", "imageio", "tifffile", "lazy-loader")  # beside what is installed already

Image = np.ndarray[Any, Any]
Work = Callable[[], Any]
Row = dict[str, Any]


def main() -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    poses = freehand_poses(FRAMES, tilt_deg=6.0)
    images = simulate(poses, probe=PHANTOM_PROBE, height=PHANTOM_IMAGE_SIDE, width=PHANTOM_IMAGE_SIDE)
    sweep = Sweep(images, poses, PHANTOM_PROBE, np.arange(FRAMES), "phantom")
    document = {
        "measured": measured(1),
        "versions": {"skimage": skimage.__version__, "cv2": cv2.__version__, "torch": torch.__version__},
        "installed_mb": {name: installed_mb(name) for name in NEEDED},
        "import_ms": {name: import_ms(name) for name in IMPORTS},
        "rows": [*of_metrics(images), *of_images()],
        "shadows": of_shadows(sweep),
    }
    write("libraries", document)


def installed_mb(name: str) -> float:
    """The size of a distribution's files."""
    return sum(file.size or 0 for file in files(name) or ()) / 1e6


def import_ms(name: str) -> float:
    """Time of an import in a fresh interpreter that has numpy already, the median of five."""
    code = (
        "import numpy, time, importlib\n"
        "began = time.perf_counter()\n"
        f"getattr(importlib.import_module({name!r}), {IMPORTS[name]!r})\n"
        "print(1000.0 * (time.perf_counter() - began))"
    )
    command = [sys.executable, "-c", code]
    runs = [subprocess.run(command, capture_output=True, text=True, check=True).stdout for _ in range(5)]
    return statistics.median(map(float, runs))


def of_metrics(images: Image) -> Iterator[Row]:
    """The metrics of a frame of the phantom, and of the next one in its place.

    Of MS-SSIM scikit-image has the SSIM at each scale only; PSNR and GMS are what is compared.
    """
    truth, shown = (image / 255.0 for image in images[FRAMES // 2 :][:2])
    small = [np.ascontiguousarray(frame[100 : 100 + SMALL, 100 : 100 + SMALL]) for frame in (truth, shown)]

    def ours() -> list[float]:
        (found,) = frame_metrics(torch.from_numpy(shown[None]), torch.from_numpy(truth[None]))
        return [found.psnr_db, found.gms]

    def theirs() -> list[float]:
        pair = [truth, shown]
        for _ in range(ms_ssim_scales(*truth.shape)):
            ssim(*pair)
            pair = [block_reduce(image, 2, np.mean) for image in pair]
        return [float(peak_signal_noise_ratio(truth, shown, data_range=1.0)), gms(truth, shown)]

    yield compared(
        f"PSNR, SSIM at every scale, GMS of {PHANTOM_IMAGE_SIDE}x{PHANTOM_IMAGE_SIDE}",
        ("torch", ours),
        ("metrics, filters.prewitt_h and _v", theirs),
    )
    yield compared(
        f"SSIM of {SMALL}x{SMALL}",
        ("torch", lambda: frame_metrics(*(torch.from_numpy(one[None]) for one in reversed(small)))[0].ms_ssim),
        ("metrics.structural_similarity", lambda: ssim(*small)),
    )


def ssim(truth: Image, shown: Image) -> float:
    """Wang's SSIM, as `evaluation.metrics` has it."""
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    return float(structural_similarity(truth, shown, data_range=1.0, **options))


def gms(truth: Image, shown: Image) -> float:
    """The mean similarity of gradient magnitudes, as `evaluation.metrics` has it."""
    a, b = (gradient_magnitude(image) for image in (shown, truth))
    constant = 170.0 / 255.0**2
    return float(((2.0 * a * b + constant) / (a * a + b * b + constant)).mean())


def gradient_magnitude(image: Image) -> Image:
    pooled = np.pad(block_reduce(image, 2, np.mean), 1)
    return np.hypot(prewitt_h(pooled), prewitt_v(pooled))[1:-1, 1:-1]


def of_images() -> Iterator[Row]:
    """Resampling, blurring and rounding of noise, where every difference shows."""
    frame = np.random.default_rng(0).random((SIDE, SIDE)).astype(np.float32)
    grey = (255.0 * frame).astype(np.uint8)
    rows, columns, _ = samples(CONVEX, frame.shape, PIXEL_MM)
    places = np.stack([rows, columns])
    size = f"{SIDE}x{SIDE}"
    yield compared(
        f"scan conversion of {size} to {rows.shape[0]}x{rows.shape[1]}",
        ("numpy", lambda: interpolated(frame, rows, columns)),
        ("transform.warp", lambda: warp(frame, places, order=1, mode="edge", preserve_range=True)),
    )
    yield compared(
        f"{size} bytes to 150x200, means of areas",
        ("OpenCV", lambda: resize_frames(grey[None], 200, 150)[0]),
        ("transform.resize_local_mean", lambda: resize_local_mean(grey, (150, 200), preserve_range=True)),
    )
    yield compared(
        f"Gaussian blur of {size}, 2 pixels",
        ("OpenCV", lambda: cv2.GaussianBlur(frame, (0, 0), 2.0, borderType=cv2.BORDER_REPLICATE)),
        ("filters.gaussian", lambda: gaussian(frame, 2.0, mode="nearest")),
    )
    yield compared(
        f"{size} to bytes", ("OpenCV", lambda: to_uint8(frame)), ("util.img_as_ubyte", lambda: img_as_ubyte(frame))
    )


def compared(what: str, ours: tuple[str, Work], theirs: tuple[str, Work]) -> Row:
    """Both results and their times; the first call of each is not timed."""
    (ours_with, our_work), (theirs_with, their_work) = ours, theirs
    our_result, their_result = (np.asarray(work(), np.float64) for work in (our_work, their_work))
    return {
        "what": what,
        "ours_with": ours_with,
        "ours_ms": elapsed_ms(our_work),
        "theirs_with": theirs_with,
        "theirs_ms": elapsed_ms(their_work),
        "difference": float(np.abs(our_result - their_result).max()),
    }


def elapsed_ms(work: Work) -> float:
    """The median of some repetitions."""
    times = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        work()
        times.append(1000.0 * (time.perf_counter() - began))
    return statistics.median(times)


def of_shadows(sweep: Sweep) -> list[Row]:
    """Pixels that are taken for the shadow of bone: of the phantom, where it is known, and of speckle without any."""
    hidden = BoneShadow.of(sweep).hidden
    noise = np.random.default_rng(0).gamma(4.0, 90.0 / 4.0, sweep.images.shape)
    speckle = Sweep(np.clip(noise, 0, 255).astype(np.uint8), sweep.poses, sweep.probe, sweep.frame_numbers, "speckle")
    found = []
    for name, method in {
        "evidence along scan lines (training/data/shadows.py)": lambda of: Shadows(of).pixels(),
        "Otsu's threshold": lambda of: below(of, threshold_otsu),
        "Otsu's threshold, regions that reach the end of the lines": lambda of: to_the_end(below(of, threshold_otsu)),
        "Li's threshold": lambda of: below(of, threshold_li),
    }.items():
        mask = method(sweep)
        both = float((mask & hidden).sum())
        found.append(
            {
                "method": name,
                "precision": both / mask.sum(),
                "recall": both / hidden.sum(),
                "overlap": both / (mask | hidden).sum(),
                "of_speckle": float(method(speckle).mean()),
            }
        )
    return found


def below(sweep: Sweep, threshold: Callable[[Image], float]) -> Image:
    """The pixels of smoothed frames below a threshold of each frame's own."""
    smooth = [cv2.GaussianBlur(image, (0, 0), 2.0) for image in sweep.images]
    return np.stack([image < threshold(image) for image in smooth])


def to_the_end(masks: Image) -> Image:
    """Of each mask the regions that reach its last row."""
    regions = [label(mask) for mask in masks]
    return np.stack([np.isin(region, np.setdiff1d(region[-1], 0)) for region in regions])


if __name__ == "__main__":
    main()

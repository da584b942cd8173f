"""Metrics against closed forms and other implementations; statistics of speckle against speckle that is known."""

import json
import math

import cv2
import numpy as np
import pytest
import pytorch_msssim
import torch
from skimage.filters import prewitt_h, prewitt_v
from skimage.measure import block_reduce
from skimage.metrics import structural_similarity

from ultragray import ConvexProbe, LinearProbe
from ultragray.errors import InvalidArgument, InvalidImageSize
from ultragray.learn.evaluation import metrics
from ultragray.learn.evaluation.metrics import FrameMetrics, frame_metrics, mean_and_std, ms_ssim, ms_ssim_scales
from ultragray.learn.evaluation.speckle import FrameSpeckle, Speckle, compare_speckle, summarize
from ultragray.rendering.display import FRAME_RANGE_DB


def speckle(*shape, seed=0):
    """Random frames with structure at every scale."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.rand(*shape, generator=generator)
    coarse = torch.rand(shape[0], 1, 5, 5, generator=generator)
    return 0.4 * noise + 0.6 * torch.nn.functional.interpolate(coarse, shape[1:], mode="bilinear")[:, 0]


def test_psnr_of_a_known_offset():
    truth = torch.rand(2, 12, 12, dtype=torch.float64) * 0.5
    far, near = frame_metrics(truth + torch.tensor([0.1, 0.01])[:, None, None], truth)
    assert far.psnr_db == pytest.approx(20.0)
    assert near.psnr_db == pytest.approx(40.0)


@pytest.mark.parametrize("size", [(11, 11), (20, 20), (11, 300), (64, 20)])
def test_one_scale_of_ms_ssim_is_the_ssim_of_scikit_image(size):
    assert ms_ssim_scales(*size) == 1
    truth = speckle(3, *size).double()
    rendered = (truth + 0.3 * (speckle(3, *size, seed=1) - 0.5)).clamp(0, 1)
    options = {"data_range": 1.0, "gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    for found, a, b in zip(frame_metrics(rendered, truth), truth.numpy(), rendered.numpy(), strict=True):
        assert found.ms_ssim == pytest.approx(structural_similarity(a, b, **options), abs=1e-12)


def test_identical_frames_reach_the_best_of_each_in_numbers_that_json_holds():
    frame = speckle(1, 40, 40)
    (reached,) = frame_metrics(frame, frame)
    assert reached.to_dict() == pytest.approx({"psnr_db": 100.0, "ms_ssim": 1.0, "gms": 1.0, "gmsd": 0.0})
    json.dumps(reached.to_dict(), allow_nan=False)


@pytest.mark.parametrize("size", [(170, 161), (163, 200)])
def test_ms_ssim_agrees_with_another_implementation(size):
    truth = speckle(3, *size).double()
    rendered = (truth + 0.2 * speckle(3, *size, seed=1) - 0.1).clamp(0, 1)
    expected = pytorch_msssim.ms_ssim(rendered[:, None], truth[:, None], data_range=1.0, size_average=False)
    found = [frame.ms_ssim for frame in frame_metrics(rendered, truth)]
    assert found == pytest.approx(expected.tolist(), abs=1e-5)
    assert ms_ssim(rendered, truth) == found


@pytest.mark.parametrize(
    ("side", "scales"), [(500, 5), (161, 5), (160, 4), (128, 4), (81, 4), (80, 3), (40, 2), (20, 1), (11, 1)]
)
def test_scales_of_ms_ssim_follow_from_the_smaller_side(side, scales):
    assert ms_ssim_scales(side, side + 100) == ms_ssim_scales(side + 100, side) == scales


@pytest.mark.parametrize(("side", "weights"), [(176, (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)), (104, None)])
def test_weights_are_renormalised_where_scales_are_missing(side, weights):
    """Flat frames have contrast terms of 1, so that only the coarsest luminance term and its weight remain."""
    x, y, c1 = 0.3, 0.5, 1e-4
    luminance = (2 * x * y + c1) / (x * x + y * y + c1)
    (reached,) = frame_metrics(torch.full((1, side, side), x), torch.full((1, side, side), y))
    weight = weights[-1] / sum(weights) if weights else 0.2363 / (0.0448 + 0.2856 + 0.3001 + 0.2363)
    assert reached.ms_ssim == pytest.approx(luminance**weight, abs=1e-6)


def gradient_magnitude(image):
    height, width = (side // 2 * 2 for side in image.shape)
    pooled = np.pad(block_reduce(image[:height, :width], 2, np.mean), 1)
    return np.hypot(prewitt_h(pooled), prewitt_v(pooled))[1:-1, 1:-1]


def test_gradient_similarity_with_the_gradients_of_scikit_image():
    truth, rendered = speckle(1, 14, 17)[0], speckle(1, 14, 17, seed=3)[0]
    a, b = (gradient_magnitude(image.double().numpy()) for image in (rendered, truth))
    c = 170 / 255**2
    similarity = (2 * a * b + c) / (a**2 + b**2 + c)
    (reached,) = frame_metrics(rendered[None], truth[None])
    assert reached.gms == pytest.approx(similarity.mean())
    assert reached.gmsd == pytest.approx(math.sqrt(((similarity - similarity.mean()) ** 2).mean()))
    assert reached.gmsd > 0.01


def test_frames_are_measured_one_by_one_however_they_are_chunked(monkeypatch):
    truth, rendered = speckle(5, 24, 20), speckle(5, 24, 20, seed=7)
    together = frame_metrics(rendered, truth)
    monkeypatch.setattr(metrics, "CHUNK_PIXELS", 2 * 24 * 20)
    for frame, alone in zip(frame_metrics(rendered, truth), together, strict=True):
        assert frame.to_dict() == pytest.approx(alone.to_dict())
    assert together[3].to_dict() == pytest.approx(frame_metrics(rendered[3:4], truth[3:4])[0].to_dict())


def test_mean_and_standard_deviation():
    frames = [FrameMetrics(20.0, 0.8, 0.9, 0.1), FrameMetrics(30.0, 0.6, 0.9, 0.3)]
    mean, std = mean_and_std(frames)
    assert mean.to_dict() == pytest.approx({"psnr_db": 25.0, "ms_ssim": 0.7, "gms": 0.9, "gmsd": 0.2})
    assert std.to_dict() == pytest.approx({"psnr_db": 5.0, "ms_ssim": 0.1, "gms": 0.0, "gmsd": 0.1})
    assert mean_and_std(frames[:1])[1] == FrameMetrics(0.0, 0.0, 0.0, 0.0)


def test_what_cannot_be_measured_is_refused():
    frame = torch.rand(1, 20, 20)
    with pytest.raises(InvalidArgument, match=r"got \[1, 20, 20\] and \[1, 20, 19\]"):
        frame_metrics(frame, frame[..., 1:])
    with pytest.raises(InvalidArgument, match="finite"):
        frame_metrics(frame / 0.0, frame)
    with pytest.raises(InvalidImageSize, match="11x11 pixels, got 20x10"):
        frame_metrics(frame[..., :10], frame[..., :10])


PROBE = LinearProbe(width_mm=38.4, near_mm=0.0, far_mm=25.6)  # 0.1 mm axial, 0.15 mm lateral at 256x256
SIGMA_PIXELS = (1.2, 2.0)  # axial, lateral: of the amplitude's point spread


def developed_speckle(seed, sigma_pixels=SIGMA_PIXELS, count=4):
    """Fully developed: the modulus of complex Gaussian noise, blurred; compressed, its mean at 0.7."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(2, count, 256, 256))
    axial, lateral = sigma_pixels
    real, imaginary = (
        [cv2.GaussianBlur(frame, (0, 0), sigmaX=lateral, sigmaY=axial) for frame in part] for part in noise
    )
    envelope = np.hypot(np.array(real), np.array(imaginary))
    decibels = 20.0 * np.log10(np.maximum(envelope / envelope.mean(), 1e-6))
    return np.clip(0.7 + decibels / FRAME_RANGE_DB, 0.0, 1.0).astype(np.float32)


def test_contrast_and_size_of_fully_developed_speckle():
    frames = developed_speckle(0)
    summary = summarize(compare_speckle(frames, frames, PROBE))
    assert summary.frames == 4
    assert summary.true == summary.rendered
    assert summary.true.contrast == pytest.approx(0.5, abs=0.04)
    # |g|'s correlation is nearly that of the squared field, exp(-x²/2σ²): half of it at 1.18 σ
    for found, sigma, pixel_mm in zip(
        (summary.true.axial_mm, summary.true.lateral_mm), SIGMA_PIXELS, (0.1, 0.15), strict=True
    ):
        assert 0.8 < found / (2.0 * 1.18 * sigma * pixel_mm) < 1.0
    assert summary.histogram_distance == 0.0


def test_a_blurred_rendering_has_less_contrast_and_larger_speckle():
    truth = developed_speckle(1)
    blurred = np.stack([cv2.GaussianBlur(frame, (0, 0), sigmaX=3.0) for frame in truth])
    summary = summarize(compare_speckle(blurred, truth, PROBE))
    assert summary.rendered.contrast < 0.5 * summary.true.contrast
    assert summary.rendered.axial_mm > 1.5 * summary.true.axial_mm
    assert summary.rendered.axial_gradient < 0.5 * summary.true.axial_gradient
    assert summary.rendered.lateral_gradient < 0.8 * summary.true.lateral_gradient
    assert summary.histogram_distance > 0.02


def test_a_shift_of_grey_is_the_distance_of_histograms():
    truth = 0.5 * developed_speckle(2) + 0.1
    (frame,) = compare_speckle(truth[:1] + 0.1, truth[:1], PROBE)
    assert frame.histogram_distance == pytest.approx(0.1, abs=1e-5)
    assert frame.rendered.contrast == pytest.approx(frame.true.contrast, rel=1e-4)


def test_windows_lie_in_homogeneous_tissue():
    truth = developed_speckle(3)
    truth[:, :128] = 0.0  # black
    truth[:, 128:160] = 1.0  # saturated
    truth[:, 160:192, ::2] = 0.9  # a structure, on whose edges quarters are alike: no better than chance
    calm, mixed = developed_speckle(3), truth
    expected, found = (summarize(compare_speckle(frames, frames, PROBE)).true for frames in (calm, mixed))
    assert found.contrast < 2.0 * expected.contrast


def test_lateral_size_in_a_fan_grows_with_depth():
    truth = developed_speckle(4)
    shallow, deep = (
        summarize(compare_speckle(truth, truth, ConvexProbe(60.0, near, near + 25.6))).true for near in (20.0, 80.0)
    )
    assert deep.lateral_mm / shallow.lateral_mm == pytest.approx(92.8 / 32.8, rel=0.1)
    assert deep.axial_mm == pytest.approx(shallow.axial_mm)


def test_a_flat_rendering_of_any_size_has_numbers_that_json_holds():
    truth = developed_speckle(5)
    summary = summarize(compare_speckle(np.zeros_like(truth), truth, PROBE))
    assert summary.rendered.contrast == 0.0
    json.dumps(summary.to_dict(), allow_nan=False)
    black = summarize(compare_speckle(truth, np.zeros_like(truth), PROBE))
    assert (black.true, black.rendered, black.frames) == (None, None, 0)
    assert black.figures() == {"histogram_distance": black.histogram_distance}
    small = summarize(compare_speckle(truth[:, :12, :20], truth[:, :12, :20], PROBE))
    assert (small.frames, small.histogram_distance) == (0, 0.0)


def test_means_are_over_the_frames_that_have_windows():
    one, other = Speckle(0.5, 0.2, 0.4, 0.02, 0.01), Speckle(0.3, 0.4, 0.8, 0.04, 0.02)
    frames = [FrameSpeckle(one, other, 0.1), FrameSpeckle(None, None, 0.3), FrameSpeckle(other, other, 0.2)]
    summary = summarize(frames)
    assert summary.true == Speckle(0.4, *map(pytest.approx, (0.3, 0.6, 0.03, 0.015)))
    assert (summary.rendered, summary.frames) == (other, 2)
    assert summary.histogram_distance == pytest.approx(0.2)
    assert summary.figures()["true_speckle_contrast"] == 0.4

"""Speckle statistics against speckle that is known: its contrast, its size, its histogram."""

import json

import cv2
import numpy as np
import pytest

from ultragray import ConvexProbe, LinearProbe
from ultragray.learn.evaluation.speckle import FrameSpeckle, Speckle, compare_speckle, summarize
from ultragray.rendering.display import FRAME_RANGE_DB

PROBE = LinearProbe(width_mm=38.4, near_mm=0.0, far_mm=25.6)  # 0.1 mm axial, 0.15 mm lateral at 256x256
SIGMA_PIXELS = (1.2, 2.0)  # axial, lateral: of the amplitude's point spread


def speckle(seed, sigma_pixels=SIGMA_PIXELS, count=4):
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
    frames = speckle(0)
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
    truth = speckle(1)
    blurred = np.stack([cv2.GaussianBlur(frame, (0, 0), sigmaX=3.0) for frame in truth])
    summary = summarize(compare_speckle(blurred, truth, PROBE))
    assert summary.rendered.contrast < 0.5 * summary.true.contrast
    assert summary.rendered.axial_mm > 1.5 * summary.true.axial_mm
    assert summary.histogram_distance > 0.02


def test_a_shift_of_grey_is_the_distance_of_histograms():
    truth = 0.5 * speckle(2) + 0.1
    (frame,) = compare_speckle(truth[:1] + 0.1, truth[:1], PROBE)
    assert frame.histogram_distance == pytest.approx(0.1, abs=1e-5)
    assert frame.rendered.contrast == pytest.approx(frame.true.contrast, rel=1e-4)


def test_windows_lie_in_homogeneous_tissue():
    truth = speckle(3)
    truth[:, :128] = 0.0  # black
    truth[:, 128:160] = 1.0  # saturated
    truth[:, 160:192, ::2] = 0.9  # a structure, on whose edges quarters are alike: no better than chance
    calm, mixed = speckle(3), truth
    expected, found = (summarize(compare_speckle(frames, frames, PROBE)).true for frames in (calm, mixed))
    assert found.contrast < 2.0 * expected.contrast


def test_lateral_size_in_a_fan_grows_with_depth():
    truth = speckle(4)
    shallow, deep = (
        summarize(compare_speckle(truth, truth, ConvexProbe(60.0, near, near + 25.6))).true for near in (20.0, 80.0)
    )
    assert deep.lateral_mm / shallow.lateral_mm == pytest.approx(92.8 / 32.8, rel=0.1)
    assert deep.axial_mm == pytest.approx(shallow.axial_mm)


def test_a_flat_rendering_of_any_size_has_numbers_that_json_holds():
    truth = speckle(5)
    summary = summarize(compare_speckle(np.zeros_like(truth), truth, PROBE))
    assert summary.rendered.contrast == 0.0
    json.dumps(summary.to_dict(), allow_nan=False)
    black = summarize(compare_speckle(truth, np.zeros_like(truth), PROBE))
    assert (black.true, black.rendered, black.frames) == (None, None, 0)
    assert black.figures() == {"histogram_distance": black.histogram_distance}
    small = summarize(compare_speckle(truth[:, :12, :20], truth[:, :12, :20], PROBE))
    assert (small.frames, small.histogram_distance) == (0, 0.0)


def test_means_are_over_the_frames_that_have_windows():
    one, other = Speckle(0.5, 0.2, 0.4), Speckle(0.3, 0.4, 0.8)
    frames = [FrameSpeckle(one, other, 0.1), FrameSpeckle(None, None, 0.3), FrameSpeckle(other, other, 0.2)]
    summary = summarize(frames)
    assert summary.true == Speckle(0.4, pytest.approx(0.3), pytest.approx(0.6))
    assert (summary.rendered, summary.frames) == (other, 2)
    assert summary.histogram_distance == pytest.approx(0.2)
    assert summary.figures()["true_speckle_contrast"] == 0.4

"""The evidence for shadows in frames."""

from dataclasses import replace

import numpy as np
import pytest

from ultragray.learn.training.geometry import Shadows

HEIGHT, WIDTH = 100, 60


def speckled(sweep, level=90.0):
    noise = np.random.default_rng(0).gamma(4.0, level / 4.0, (len(sweep), HEIGHT, WIDTH))
    return np.clip(noise, 0, 255).astype(np.uint8)


def evidence(sweep, images):
    return Shadows(replace(sweep, images=images))


def test_a_shadow_lasts_to_the_end_of_the_line_and_a_vessel_does_not(tiny_dataset):
    sweep = tiny_dataset().train
    images = speckled(sweep)
    images[:, 30:, 10:20] //= 20
    images[:, 30:60, 40:50] //= 20
    beam = evidence(sweep, images).of(0)
    assert beam.left[35:, 12:18].mean() < 0.2
    assert beam.left[:25, 12:18].mean() > 0.9
    assert beam.left[:, 40:50].mean() > 0.9
    assert beam.echo[35:, 12:18].mean() == pytest.approx(90 / 255, rel=0.2), "as bright as tissue with the whole beam"


def test_half_of_the_beam_is_told(tiny_dataset):
    sweep = tiny_dataset().train
    images = speckled(sweep)
    images[:, 30:, 10:20] //= 2
    left = evidence(sweep, images).of(0).left
    assert left[35:85, 12:18].mean() == pytest.approx(0.5, abs=0.12)


def test_a_depth_that_is_dark_everywhere_is_no_evidence(tiny_dataset):
    sweep = tiny_dataset().train
    dots = np.zeros((len(sweep), HEIGHT, WIDTH), np.uint8)
    dots[:, 40:43, 20:24] = 250
    dots[:, 0, 0] = 1
    assert not evidence(sweep, dots).of(0).is_shadowed.any()
    fading = speckled(sweep)
    fading[:, 60:] = 2
    assert evidence(sweep, fading).of(0).left[:, 5:-5].mean() > 0.95


@pytest.mark.parametrize("level", [0, 1])
def test_a_line_without_contact_casts_no_shadow(tiny_dataset, level):
    sweep = tiny_dataset().train
    images = speckled(sweep)
    images[:, :, 10:20] = level
    assert not evidence(sweep, images).of(0).is_shadowed[:, 14:16].any()

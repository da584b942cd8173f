"""What a trained scene shows where no frame was: in gaps, beyond the ends, in the dark."""

from dataclasses import replace

import numpy as np
import pytest

from ultragray.learn.evaluation.baselines import predict
from ultragray.learn.evaluation.scoring import render_sweep
from ultragray.learn.training import train


def psnr_db(images, truth):
    return float((-10.0 * np.log10(np.square(images - truth / 255.0).mean(axis=(1, 2)))).mean())


def with_gap(dataset, first, last):
    """The frames from `first` to `last` of all are held out, no others."""
    places = np.arange(len(dataset.train))
    held_out = (places >= first) & (places <= last)
    return replace(dataset, train=dataset.train.select(places[~held_out]), val=dataset.train.select(places[held_out]))


def test_a_gap_is_as_bright_as_its_edges_tell(tiny_dataset, tiny_config):
    dataset = with_gap(tiny_dataset(frames=40, height=40, width=32, spacing_mm=0.4), 12, 19)
    settings = {"steps": 150, "max_gaussians": 1500, "refinements": 0, "batch_size": 8}
    filled = train(dataset, tiny_config(**settings))
    alone = train(dataset, tiny_config(**settings, views_between=0.0))
    linear = psnr_db(predict(dataset.train, dataset.val.poses, "linear"), dataset.val.images)
    found = [psnr_db(render_sweep(scene, dataset.val), dataset.val.images) for scene in (filled, alone)]
    assert found[0] > linear - 0.5
    assert found[0] > found[1] + 1.0


def test_beyond_an_end_the_last_frame_goes_on(tiny_dataset, tiny_config):
    dataset = with_gap(tiny_dataset(frames=24, height=40, width=32, spacing_mm=0.5), 14, 17)
    scene = train(dataset, tiny_config(steps=100, max_gaussians=1500, refinements=0, batch_size=8))
    assert dataset.val.poses[-1, 1, 3] - dataset.train.poses[-1, 1, 3] > 2.0
    assert psnr_db(render_sweep(scene, dataset.val), dataset.val.images) > 20.0


def test_darkness_that_is_no_shadow_is_not_explained_by_absorption(tiny_dataset, tiny_config):
    dataset = tiny_dataset(frames=16, height=60, width=48)
    rows, columns = np.mgrid[:60, :48]
    spots = [
        np.exp(-((rows - 15) ** 2 + (columns - 10 - place) ** 2) / 8.0)
        + np.exp(-((rows - 35) ** 2 + (columns - 30) ** 2) / 8.0)
        for place in range(len(dataset.train))
    ]
    images = (230.0 * np.array(spots)).astype(np.uint8)
    dataset = replace(dataset, train=replace(dataset.train, images=images), val=dataset.val.select([]))
    settings = {"steps": 150, "max_gaussians": 1500, "refinements": 0, "batch_size": 8}
    scene = train(dataset, tiny_config(**settings))
    assert render_sweep(scene, dataset.train, output="transmittance").mean() > 0.9


@pytest.mark.long
def test_absorption_costs_nothing_where_frames_show_a_shadow(tiny_dataset, tiny_config):
    dataset = tiny_dataset(frames=16, height=60, width=48)
    speckle = np.random.default_rng(0).gamma(4.0, 22.0, (len(dataset.train), 60, 48))
    speckle[:, 18:22, 15:30] = 230.0
    speckle[:, 22:, 15:30] /= 20.0
    images = np.clip(speckle, 0, 255).astype(np.uint8)
    dataset = replace(dataset, train=replace(dataset.train, images=images), val=dataset.val.select([]))
    settings = {"steps": 150, "max_gaussians": 1500, "refinements": 0, "batch_size": 8}
    scene = train(dataset, tiny_config(**settings, absorption_penalty=1.0))
    transmittance = render_sweep(scene, dataset.train, output="transmittance")
    assert transmittance[:, 35:, 18:27].mean() < 0.3
    assert transmittance[:, :, 38:].mean() > 0.97

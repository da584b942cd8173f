"""The detector of seams finds those that were made, and none around a body that was put in."""

import numpy as np
import pytest
import torch

from ultragray.learn.editing.insertion import insert
from ultragray.learn.editing.parts import means_mm, part, with_echo
from ultragray.learn.labelling import undirected_echo
from ultragray.phantom.demo import load_demo_scene

from ..scripts import benchmark

editing = benchmark("editing")

BAND_MM = 0.75  # width of what is made
LEVEL = 0.2  # of the grey range: 12 dB of 60
CYST, TUMOUR, BESIDE_BONE, IN_BONE = 101, 150, 267, 235  # seeds


def with_gap(scene, edit):
    edited = insert(scene, edit)
    return part(edited, ~beside(edited, edit, outside=True))


def with_band(scene, edit, *, outside, level):
    edited = insert(scene, edit)
    echo = undirected_echo(edited) + level * beside(edited, edit, outside=outside)
    return with_echo(edited, torch.from_numpy(echo).to(edited.means))


def beside(edited, edit, *, outside):  # [N]
    away = edit.shape.distance_mm(means_mm(edited))
    is_body = np.isin(edited.labels.numpy(), edited.info.made_labels)
    return (np.abs(away) < BAND_MM) & (is_body != outside)


MADE = {
    "gap": with_gap,
    "bright rim": lambda *given: with_band(*given, outside=True, level=LEVEL),
    "bright edge of the body": lambda *given: with_band(*given, outside=False, level=LEVEL),
}


@pytest.fixture(scope="module")
def scene():
    return load_demo_scene()


@pytest.mark.parametrize("seed", [CYST, TUMOUR, BESIDE_BONE, IN_BONE])
def test_no_seam_is_found_around_a_body(scene, seed):
    largest, label_error_pixels = editing.changes(scene, seed, insert)
    assert largest < editing.SEAM
    assert label_error_pixels < 1.0


@pytest.mark.parametrize("seed", [CYST, TUMOUR, BESIDE_BONE])
@pytest.mark.parametrize("made", MADE)
def test_a_seam_that_was_made_is_found(scene, made, seed):
    assert editing.changes(scene, seed, MADE[made])[0] > editing.SEAM

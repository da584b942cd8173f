"""What a comparison found, as JSON and back."""

import json

import numpy as np
import pytest

from ultragray.learn.evaluation.methods import ComparisonSettings
from ultragray.learn.sweep import Distances
from ultragray_studies.comparison.result import FORMAT_VERSION, Comparison
from ultragray_studies.comparison.run import compare_methods


def test_a_comparison_is_the_same_after_json(dataset, methods, paces, tmp_path):
    found = compare_methods(dataset, methods, ComparisonSettings(), folder=tmp_path, paces=paces)
    document = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    again = Comparison.from_dict(document)
    assert again.to_dict() == document
    assert again.results[0].description == found.results[0].description
    assert [row.title for row in again.results] == [row.title for row in found.results]
    assert again.measured["scene"].speckle == found.measured["scene"].speckle
    newer = {**document, "format_version": FORMAT_VERSION + 1}
    with pytest.raises(ValueError, match="a newer release wrote it"):
        Comparison.from_dict(newer)


def test_distances_are_those_to_the_nearest_training_frame(dataset):
    found = Distances.of(dataset)
    places = dataset.val.poses[:, 1, 3][:, None] - dataset.train.poses[:, 1, 3][None]
    np.testing.assert_allclose(found.mm, np.abs(places).min(axis=1), atol=1e-12)
    np.testing.assert_allclose(found.deg, 0.0, atol=1e-6)

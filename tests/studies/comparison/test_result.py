"""What a comparison found, as JSON and back."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ultragray.datasets import Dataset
from ultragray.learn.evaluation.methods import ComparisonSettings
from ultragray.learn.sweep import Distances
from ultragray_studies.comparison.result import FORMAT_VERSION, Comparison
from ultragray_studies.comparison.run import compare_methods
from ultragray_studies.methods.method import Method, Paces


def test_a_comparison_is_the_same_after_json(
    dataset: Dataset, methods: dict[str, Method], paces: Paces, tmp_path: Path
) -> None:
    found = compare_methods(dataset, methods, ComparisonSettings(), folder=tmp_path, paces=paces)
    assert found is not None
    document = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    again = Comparison.from_dict(document)
    assert again.to_dict() == document
    assert again.results[0].description == found.results[0].description
    assert [row.title for row in again.results] == [row.title for row in found.results]
    assert again.measured["scene"].speckle == found.measured["scene"].speckle
    newer = {**document, "format_version": FORMAT_VERSION + 1}
    with pytest.raises(ValueError, match="a newer release wrote it"):
        Comparison.from_dict(newer)


def test_distances_are_those_to_the_nearest_training_frame(dataset: Dataset) -> None:
    found = Distances.of(dataset)
    places = dataset.val.poses[:, 1, 3][:, None] - dataset.train.poses[:, 1, 3][None]
    np.testing.assert_allclose(found.mm, np.abs(places).min(axis=1), atol=1e-12)
    np.testing.assert_allclose(found.deg, 0.0, atol=1e-6)

"""What a comparison found, as JSON; a row also back."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ultragray.datasets import Dataset
from ultragray.learn.evaluation.methods import ComparisonSettings
from ultragray.learn.sweep import Distances
from ultragray_studies.comparison.result import MethodResult
from ultragray_studies.comparison.run import compare_methods
from ultragray_studies.methods.method import Method, Paces


def test_a_row_is_the_same_after_json(
    dataset: Dataset, methods: dict[str, Method], paces: Paces, tmp_path: Path
) -> None:
    found = compare_methods(dataset, methods, ComparisonSettings(), folder=tmp_path, paces=paces)
    assert found is not None
    for row in found.results:
        document = json.loads(json.dumps(row.to_dict(), allow_nan=False))
        again = MethodResult.from_dict(document)
        assert again.to_dict() == document
        assert (again.description, again.title) == (row.description, row.title)
        if row.evaluation is not None and again.evaluation is not None:
            assert again.evaluation.speckle == row.evaluation.speckle


def test_distances_are_those_to_the_nearest_training_frame(dataset: Dataset) -> None:
    found = Distances.of(dataset)
    places = dataset.val.poses[:, 1, 3][:, None] - dataset.train.poses[:, 1, 3][None]
    np.testing.assert_allclose(found.mm, np.abs(places).min(axis=1), atol=1e-12)
    np.testing.assert_allclose(found.deg, 0.0, atol=1e-6)

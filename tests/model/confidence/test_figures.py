import numpy as np

from ultragray.scene.confidence import FIGURES, Extrapolation, figure_arrays


def test_each_figure_is_an_array_and_nan_where_it_is_not_known():
    arrays = figure_arrays([Extrapolation(1.0, 2.0, 0.75, 0.25), Extrapolation(3.0, 4.0, None, None)])
    assert tuple(arrays) == FIGURES == ("distance_mm", "angle_deg", "confidence", "supported_share")
    assert {values.dtype for values in arrays.values()} == {np.dtype(np.float32)}
    np.testing.assert_array_equal(list(arrays.values()), [[1, 3], [2, 4], [0.75, np.nan], [0.25, np.nan]])


def test_of_no_frames():
    assert [values.shape for values in figure_arrays([]).values()] == [(0,)] * 4

"""Image sizes, as asked for."""

import numpy as np
import pytest

from ultragray.errors import InvalidImageSize
from ultragray.geometry.image_size import MAX_IMAGE_SIDE, check_image_size


@pytest.mark.parametrize("side", [1, 512, MAX_IMAGE_SIDE, np.int64(7)])
def test_sizes_within_the_limit(side):
    check_image_size(side, 1)
    check_image_size(1, side)


@pytest.mark.parametrize("side", [0, -1, MAX_IMAGE_SIDE + 1, 1.0, "512", None, True, float("nan")])
@pytest.mark.parametrize("field", ["height", "width"])
def test_other_sizes_are_refused_by_name(side, field):
    with pytest.raises(InvalidImageSize, match=f"^{field} must be an integer from 1 to {MAX_IMAGE_SIDE}") as caught:
        check_image_size(**{"height": 8, "width": 8, field: side})
    assert caught.value.field == field


def test_a_service_may_set_a_lower_limit():
    with pytest.raises(InvalidImageSize, match="from 1 to 100"):
        check_image_size(101, 8, limit=100)

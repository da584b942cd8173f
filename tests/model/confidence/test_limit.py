import pytest

from ultragray.errors import LowConfidence
from ultragray.scene.confidence import Extrapolation, is_confident, require_confidence

NEAR = Extrapolation(0.5, 1.0, 0.8, None)
FAR = Extrapolation(12.34, 5.67, 0.3, None)
UNKNOWN = Extrapolation(None, None, None, 0.5)


def test_the_limit_itself_will_do_and_what_is_not_known_has_none():
    assert is_confident(NEAR, 0.8)
    assert not is_confident(NEAR, 0.81)
    assert is_confident(UNKNOWN, 0.0)
    assert not is_confident(UNKNOWN, 0.01)


def test_the_first_pose_below_the_limit_is_named():
    require_confidence([NEAR, FAR, UNKNOWN], None)
    require_confidence([NEAR, FAR], 0.3)
    with pytest.raises(LowConfidence) as caught:
        require_confidence([NEAR, FAR, FAR], 0.5)
    assert caught.value.field == "poses[1]"
    assert caught.value.detail == (
        "poses[1] has a confidence of 0.30, 0.5 is asked for: the nearest training views are 12.3 mm and 5.7 degrees "
        "away"
    )
    with pytest.raises(LowConfidence, match=r"poses\[0\] has a confidence of 0\.00, 0\.5 is asked for$"):
        require_confidence([UNKNOWN], 0.5)

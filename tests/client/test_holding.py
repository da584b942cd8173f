"""Go or hold still, by what a frame tells."""

from dataclasses import replace

import numpy as np
import pytest

from ultragray_client import Client, HoldStill, RenderSettings
from ultragray_client.contract import Prediction, Preview
from ultragray_client.errors import DeadlineExceeded

from .conftest import KEY

PREVIEW = Preview(
    real_age_ms=300.0,
    moved_mm=2.0,
    is_real=False,
    expected_error=0.1,
    agreement=0.5,
    trust=0.4,
    offset_mm=0.0,
    offset_deg=0.0,
    disagrees=False,
)


@pytest.fixture
def frame(client_service):
    with Client(client_service.grpc, api_key=KEY) as client:
        found = client.render("demo", np.eye(4), RenderSettings(height=16, width=16))
    told = replace(found.extrapolation, confidence=0.8, contact_share=1.0)
    return replace(found, extrapolation=told, latency_ms=20.0)


def test_a_frame_within_all_limits_is_acted_on(frame):
    still = HoldStill(most_age_ms=50, least_confidence=0.7, least_contact=0.9)
    assert still.reason(frame) is None
    assert still.reason(frame, waited_ms=30.0) is None
    assert HoldStill().reason(replace(frame, latency_ms=None)) is None


@pytest.mark.parametrize(
    ("still", "changes", "expected"),
    [
        (HoldStill(most_error_mm=0.5), {}, "error of the pose is not told"),
        (HoldStill(most_error_mm=0.5), {"prediction": Prediction(50.0, None, None)}, "error of the pose is not told"),
        (HoldStill(most_error_mm=0.5), {"prediction": Prediction(50.0, 0.61, 0.1)}, "error of the pose of 0.61 mm"),
        (HoldStill(most_age_ms=19), {}, "age of 20 ms"),
        (HoldStill(most_age_ms=19), {"latency_ms": None}, "age is not told"),
        (HoldStill(most_age_ms=19), {"latency_ms": float("nan")}, "age of nan ms"),
        (HoldStill(least_confidence=0.81), {}, "confidence of 0.80"),
        (HoldStill(least_confidence=0.1), {"confidence": None}, "confidence is not told"),
        (HoldStill(least_trust=0.5), {}, "trust is not told"),
        (HoldStill(least_trust=0.5), {"preview": PREVIEW}, "trust of 0.40"),
        (HoldStill(least_trust=0.4), {"preview": PREVIEW}, None),
        (HoldStill(least_contact=0.9), {"contact_share": 0.5}, "contact of 0.50"),
        (HoldStill(least_contact=0.9), {"contact_share": None}, "contact is not told"),
    ],
)
def test_a_limit_holds(frame, still, changes, expected):
    own = {"latency_ms", "prediction", "preview"} & changes.keys()
    told = replace(frame.extrapolation, **{name: changes[name] for name in changes.keys() - own})
    assert still.reason(replace(frame, extrapolation=told, **{name: changes[name] for name in own})) == expected


def test_no_frame_and_an_old_one_hold(frame):
    assert HoldStill().reason(None) == "no frame in time"
    assert HoldStill().reason(DeadlineExceeded("late")) == "no frame: DEADLINE_EXCEEDED"
    assert HoldStill(most_age_ms=50).reason(frame, waited_ms=31.0) == "age of 51 ms"

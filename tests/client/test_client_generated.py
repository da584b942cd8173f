"""What client/generate.py writes is committed as it writes it."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from ultragray.geometry import pose as library_pose
from ultragray.geometry.probe import Probe
from ultragray.rendering import settings
from ultragray.rendering.display import AS_RENDERED
from ultragray_client import (
    PROBES,
    Display,
    RenderSettings,
    check_poses,
    pose_from_position_quaternion,
    quaternion_from_pose,
)
from ultragray_client.errors import InvalidPose
from ultragray_service.errors import STATUSES

from ..scripts import loaded

CLIENT = Path(__file__).resolve().parents[2] / "client"


@pytest.fixture(scope="module")
def generator():
    return loaded(CLIENT / "generate.py")


def test_the_contract_is_current(generator, tmp_path):
    committed = CLIENT / "ultragray_client" / "contract.py"
    assert committed.read_text() == generator.generate_contract(tmp_path).read_text()


def test_the_errors_are_current(generator, tmp_path):
    committed = CLIENT / "ultragray_client" / "errors.py"
    assert committed.read_text() == generator.generate_errors(tmp_path).read_text()
    assert STATUSES.keys() > generator.NOT_OVER_GRPC


def test_the_copies_are_current(generator, tmp_path):
    for path in generator.generate_copies(tmp_path):
        committed = CLIENT / "ultragray_client" / path.relative_to(tmp_path)
        assert committed.read_text() == path.read_text()


def test_the_client_checks_poses_and_knows_probes_by_name():
    pose = pose_from_position_quaternion((1, 2, 3), (0.8, 0.0, 0.6, 0.0))
    assert (pose == library_pose.pose_from_position_quaternion((1, 2, 3), (0.8, 0.0, 0.6, 0.0))).all()
    assert quaternion_from_pose(check_poses(pose)[0]) == pytest.approx((0.8, 0.0, 0.6, 0.0))
    with pytest.raises(InvalidPose, match="mirrored") as refused:
        check_poses(np.diag([1.0, 1.0, -1.0, 1.0]))
    assert (refused.value.reason, refused.value.field) == ("INVALID_POSE", "poses")
    assert {name: asdict(probe) for name, probe in PROBES.items()} == {
        name: asdict(probe) for name, probe in Probe.named.items()
    }


def test_the_contract_has_the_defaults_of_the_library():
    for own, library in ((RenderSettings(), settings.RenderSettings()), (Display(), AS_RENDERED)):
        assert asdict(own) == asdict(library)

"""Motion jobs of a running service: what it serves when they have succeeded."""

import json

import numpy as np
import pytest

from ultragray_client import Client, MotionJob, RenderSettings, TubeShape
from ultragray_client.errors import InvalidArgument

from .cli.command_line import run
from .conftest import DEMO_PROBE, make_scene


@pytest.fixture(scope="module")
def motion_service(start_service, tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    make_scene(60, probe=DEMO_PROBE).save(folder / "still.ugr")
    return start_service(data_folder=folder, artifact_folder=tmp_path_factory.mktemp("artifacts"), embedded_worker=True)


@pytest.fixture(scope="module")
def client(motion_service):
    with Client(motion_service.grpc, timeout_s=300) as client:
        yield client


def test_a_scene_gets_two_modes_and_is_served_at_their_phases(client, motion_service):
    job = client.jobs.submit(MotionJob(scene="still", into="breathing", chest_mm=6.0))
    assert client.jobs.wait(job.id, timeout_s=300).state.value == "succeeded"
    asked = ("breathing", "--into", "both", "--pulse-mm", 1, "--vessel")
    tube = json.dumps({"kind": "tube", "points_mm": [[0, -20, 15], [0, 20, 15]], "radius_mm": 6.0})
    made = run("jobs", "submit", "motion", *asked, tube, "--wait", "--address", motion_service.http)
    assert made.exit_code == 0, made.output
    assert [mode.name for mode in client.scenes.get("both").modes] == ["breathing", "pulse"]
    frames = [
        client.render("both", np.eye(4), RenderSettings(phase=phase))["bmode"]
        for phase in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
    ]
    assert not np.array_equal(frames[0], frames[1])
    assert not np.array_equal(frames[0], frames[2])
    assert not np.array_equal(frames[1], frames[2])


def test_a_vessel_that_is_none_is_refused_at_its_submission(client):
    with pytest.raises(InvalidArgument, match="belong together"):
        client.jobs.submit(MotionJob(scene="still", into="other", pulse_mm=1.0))
    with pytest.raises(InvalidArgument) as caught:
        client.jobs.submit(
            MotionJob(scene="still", into="other", pulse_mm=1.0, vessel=TubeShape(((0.0, 0.0, 0.0),), 1.0))
        )
    assert caught.value.field == "motion.vessel.tube.points_mm"

"""Motion jobs of a running service: what it serves when they have succeeded."""

import base64
import json

import nibabel
import numpy as np
import pytest

from ultragray import render
from ultragray.learn.motion import add_motion
from ultragray.learn.motion_fields import field_of_voxels
from ultragray.scene.label_maps import read_vector_field
from ultragray.scene.motion_settings import MotionSettings
from ultragray_client import Client, Encoding, FieldFile, MotionJob, RenderSettings, TubeShape
from ultragray_client.errors import InvalidArgument

from .cli.command_line import refused, run, succeeded
from .conftest import DEMO_PROBE, make_scene


@pytest.fixture(scope="module")
def still():
    return make_scene(60, probe=DEMO_PROBE)


@pytest.fixture(scope="module")
def motion_service(start_service, tmp_path_factory, still):
    folder = tmp_path_factory.mktemp("scenes")
    still.save(folder / "still.ugr")
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


@pytest.fixture(scope="module")
def field_file(tmp_path_factory):
    """Deep tissue goes down by 4 mm and aside by 2, as ITK writes it: NIfTI whose vectors are in LPS."""
    path = tmp_path_factory.mktemp("field") / "inhale.nii.gz"
    share = np.linspace(0.0, 1.0, 7)[:, None] * np.array([-2.0, 0.0, 4.0])
    affine = np.diag([15.0, 15.0, 10.0, 1.0])
    affine[:3, 3] = -45.0, -45.0, -5.0
    nibabel.save(nibabel.Nifti1Image(np.broadcast_to(share, (7, 7, 7, 3)).astype(np.float32), affine), path)
    return path


def data_of(path):
    return FieldFile(base64.b64encode(path.read_bytes()).decode(), "nii.gz")


def test_a_field_of_a_file_moves_a_scene_as_the_library_has_it(client, motion_service, field_file, still):
    submitted = ("jobs", "submit", "motion", "still", "--wait", "--address", motion_service.http, "--field", field_file)
    succeeded(*submitted, "--into", "by-http", "--field-leads", "to-rest", "--field-axes", "lps")
    link = np.eye(4)
    link[:3, 3] = 3.0, 0.0, 5.0
    client.registrations.put("room", "still", link)
    asked = {"field": data_of(field_file), "field_leads": "to-rest", "field_axes": "lps"}
    job = client.jobs.submit(MotionJob(scene="still", into="by-grpc", registration="room", **asked))
    assert client.jobs.wait(job.id, timeout_s=300).state.value == "succeeded"

    seen, voxels = set(), read_vector_field(field_file, "lps")
    for name, to_scene in (("by-http", None), ("by-grpc", link)):
        field = field_of_voxels(voxels, still.info, "to-rest", to_scene)
        expected = add_motion(still, MotionSettings(), field=field).scene
        for phase in (0.4, 1.0):
            shown = client.render(name, np.eye(4), RenderSettings(phase=(phase,), encoding=Encoding.FLOAT32))["bmode"]
            height, width = shown.shape
            frames = render(expected.at_phase((phase,)), None, np.eye(4), height=height, width=width)
            np.testing.assert_allclose(shown, frames["bmode"][0].numpy(), atol=1e-6)
            seen.add(shown.tobytes())
    assert len(seen) == 4


def test_a_field_is_checked_at_its_submission_as_the_command_checks_it(client, motion_service, field_file, tmp_path):
    submit = ("jobs", "submit", "motion", "still", "--into", "other", "--address", motion_service.http, "--field")
    assert "field and field_leads belong together" in refused(*submit, field_file)
    leads = ("--field-leads", "from-rest")
    assert "field.nii.gz does not say in which axes its vectors are" in refused(*submit, field_file, *leads)
    assert "must end in one of .nii, .nii.gz, .nrrd, .h5, .tfm" in refused(*submit, tmp_path / "field.txt", *leads)
    (tmp_path / "cut.nrrd").write_bytes(b"NRRD0004\n\n")
    assert "field.nrrd cannot be read as NRRD" in refused(*submit, tmp_path / "cut.nrrd", *leads)
    for data, field in (("%", "motion.field.data"), (data_of(field_file).data, "motion.field_axes")):
        with pytest.raises(InvalidArgument) as caught:
            client.jobs.submit(MotionJob(scene="still", into="other", field=FieldFile(data), field_leads="from-rest"))
        assert caught.value.field == field
    (tmp_path / "large.nii").write_bytes(bytes(7 * 2**20))
    assert "at most 8388608 bytes" in refused(*submit, tmp_path / "large.nii", *leads)

"""Volumes and slices of a served scene: the same numbers through every door as from the library."""

import io
import json

import cv2
import numpy as np
import pytest
import SimpleITK
import torch

from ultragray import GaussianScene, SceneInfo
from ultragray.rendering.volume_fields import sample_slice, sample_volume
from ultragray.rendering.volumes import VOLUME_FIELDS, VolumeGrid
from ultragray_client import SliceSettings, VoxelizeJob
from ultragray_client.errors import InvalidArgument, SceneNotFound

from .conftest import DEMO_PROBE, make_scene

PLANE = {"origin_mm": [-15, -1, 5], "right": [2, 0.1, 0], "down": [0, 0, 3], "size_mm": [30, 25], "spacing_mm": 0.5}
GRID = VolumeGrid.on_plane((-15, -1, 5), (2, 0.1, 0), (0, 0, 3), (30, 25), 0.5)
FIELDS = pytest.mark.parametrize("field", VOLUME_FIELDS)
RAW, NPY, PNG = "application/octet-stream", "application/x-npy", "image/png"


@pytest.fixture(scope="module")
def scene():
    plain = make_scene(probe=DEMO_PROBE)
    labels = torch.tensor([0, 1, 200, 200], dtype=torch.uint8).repeat(100)
    info = SceneInfo(centre_mm=plain.info.centre_mm, probe=DEMO_PROBE, label_names={1: "bone", 200: "vessel"})
    return GaussianScene.from_splats(plain.splats, info=info, labels=labels)


@pytest.fixture(scope="module")
def service(start_service, tmp_path_factory, scene):
    folder = tmp_path_factory.mktemp("volumes")
    scene.save(folder / "labelled.ugr")
    make_scene(20, probe=DEMO_PROBE).save(folder / "plain.ugr")
    limits = {"max_image_side": 600, "max_request_pixels": 200_000, "max_footprint_pixels": 16_000_000}
    artifacts = tmp_path_factory.mktemp("artifacts")
    return start_service(data_folder=folder, artifact_folder=artifacts, embedded_worker=True, **limits)


def expected(scene, field):
    found = sample_slice(scene, field, GRID)
    assert found.any()
    return found


def ask(http, accept="*/*", *, scene="labelled", **changes):
    return http.post(f"/v1/scenes/{scene}:slice", json={**PLANE, **changes}, headers={"Accept": accept})


# Slices


@FIELDS
def test_a_slice_has_the_numbers_of_the_library(http, scene, field):
    truth = expected(scene, field)
    answer = ask(http, NPY, field=field)
    assert answer.status_code == 200, answer.text
    assert answer.headers["Content-Type"] == NPY
    pixels = np.load(io.BytesIO(answer.content))
    assert pixels.dtype == truth.dtype
    np.testing.assert_array_equal(pixels, truth)
    raw = ask(http, RAW, field=field)
    assert raw.headers["X-Ultragray-Shape"] == f"{truth.shape[0]},{truth.shape[1]}"
    np.testing.assert_array_equal(np.frombuffer(raw.content, raw.headers["X-Ultragray-Dtype"]), truth.ravel())
    np.testing.assert_allclose(json.loads(raw.headers["X-Ultragray-Pixel-To-Scene"]), GRID.affine, atol=1e-12)


@FIELDS
def test_a_slice_is_a_picture_where_nothing_else_is_asked_for(http, scene, field):
    answer = ask(http, field=field)
    assert (answer.status_code, answer.headers["Content-Type"]) == (200, PNG)
    picture = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED)
    truth = expected(scene, field)
    if field != "labels":
        truth = np.rint(255 * truth / (truth.max() if field == "attenuation" else 1.0))
    assert np.abs(picture.astype(float) - truth).max() <= 1


@FIELDS
def test_the_client_gets_a_slice_over_grpc(client, scene, field):
    plane = SliceSettings(field=field, origin_mm=(-15, -1, 5), right=(2, 0.1, 0), down=(0, 0, 3), size_mm=(30, 25))
    found = client.render_slice("labelled", plane)
    np.testing.assert_array_equal(found.pixels, expected(scene, field))
    np.testing.assert_allclose(found.pixel_to_scene, GRID.affine, atol=1e-12)
    assert (found.scene, found.field, len(found.scene_sha256)) == ("labelled", field, 64)
    assert found.timings.render_ms > 0


@pytest.mark.parametrize(
    ("changes", "status", "field", "text"),
    [
        ({"field": "bmode"}, 422, "field", "one of echo, coverage, attenuation, labels"),
        ({"field": "labels", "scene": "plain"}, 422, "field", "this one's carry none"),
        ({"scene": "absent"}, 404, "scene", "absent"),
        ({"down": [1, 0, 0]}, 422, "down", "right angle"),
        ({"spacing_mm": 0.01}, 422, "spacing_mm", "at most 600 pixels on a side"),
        ({"size_mm": [250, 250]}, 422, "spacing_mm", "200000 in all"),
    ],
)
def test_a_slice_that_cannot_be_is_refused(http, changes, status, field, text):
    problem = ask(http, **changes)
    assert problem.status_code == status, problem.text
    assert problem.json()["field"] == field
    assert text in problem.json()["detail"]


def test_a_slice_that_costs_too_much_at_once_comes_in_pieces_of_rows(http, scene, service):
    before = service.metric("ultragray_frames_total")
    answer = ask(http, RAW, origin_mm=[-22, 0, 0], right=[1, 0, 0], size_mm=[44, 40], spacing_mm=0.1)
    assert answer.status_code == 200, answer.text
    plane = VolumeGrid.on_plane((-22, 0, 0), (1, 0, 0), (0, 0, 1), (44, 40), 0.1)
    pixels = np.frombuffer(answer.content, np.float32).reshape(400, 440)
    np.testing.assert_allclose(pixels, sample_slice(scene, "echo", plane), atol=1e-5)
    assert service.metric("ultragray_frames_total") > before + 2


def test_other_types_of_answers_are_not_acceptable(http):
    answer = ask(http, "image/jpeg")
    assert answer.status_code == 406
    assert "image/png, application/x-npy, application/octet-stream" in answer.json()["detail"]


def test_refusals_over_grpc_name_the_field(client):
    with pytest.raises(SceneNotFound):
        client.render_slice("absent", SliceSettings(origin_mm=(0, 0, 0), size_mm=(10, 10)))
    with pytest.raises(InvalidArgument) as caught:
        client.render_slice("labelled", SliceSettings(origin_mm=(0, 0, 0), size_mm=(10, 10), down=(1, 0, 0)))
    assert caught.value.field == "slice.down"


def test_a_slice_counts_as_a_frame(http, service):
    before = service.metric("ultragray_frames_total")
    assert ask(http).status_code == 200
    assert service.metric("ultragray_frames_total") == before + 1


# Jobs


def test_a_volume_is_made_by_a_job_of_the_client(client, scene, tmp_path):
    job = client.jobs.submit(VoxelizeJob("labelled", field="labels", spacing_mm=2.0, format="nrrd"))
    done = client.jobs.wait(job.id, timeout_s=300)
    assert (done.state.value, done.kind) == ("succeeded", "voxelize"), done.error
    assert set(done.artifacts) == {"labels.nrrd", "volume.json"}
    client.jobs.download(job.id, "labels.nrrd", tmp_path / "labels.nrrd")
    image = SimpleITK.ReadImage(str(tmp_path / "labels.nrrd"))
    grid = VolumeGrid.over_scene(scene.info, None, 2.0)
    np.testing.assert_array_equal(
        SimpleITK.GetArrayFromImage(image), np.concatenate(list(sample_volume(scene, "labels", grid)))
    )
    assert (done.progress.frames_done, done.progress.frames) == (grid.shape[2], grid.shape[2])


@pytest.mark.parametrize(
    ("changes", "field", "text"),
    [
        ({"field": "bmode"}, "specification.field", "one of echo"),
        ({"scene": "plain", "field": "labels"}, "specification.field", "carry none"),
        ({"box_mm": "0:1,0:1,1:0"}, "specification.box_mm", "extend along each axis"),
        ({"spacing_mm": 0.001}, "specification.spacing_mm", "the limit is"),
        ({"format": "mha"}, "specification.format", "one of nii.gz, nii, nrrd"),
    ],
)
def test_a_volume_that_cannot_be_is_refused_at_its_submission(http, changes, field, text):
    specification = {"scene": "labelled", **changes}
    answer = http.post("/v1/jobs", json={"kind": "voxelize", "specification": specification})
    assert answer.status_code == 422, answer.text
    assert answer.json()["field"] == field
    assert text in answer.json()["detail"]

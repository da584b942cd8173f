"""`ultragray scenes`, `datasets`, `recordings` and `registrations` against a real service."""

import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from ultragray import read_header
from ultragray_service.cli.app import app

from ..conftest import HEIGHT, WIDTH
from .command_line import noise_sweep

KEY = "0123456789abcdef-remote"


@pytest.fixture(scope="module")
def server(start_service, artifacts):
    return start_service(artifact_folder=artifacts, api_keys=KEY)


def run(server, *arguments, key=KEY):
    environment = {"ULTRAGRAY_ADDRESS": server.http, "ULTRAGRAY_API_KEY": key}
    return CliRunner().invoke(app, list(map(str, arguments)), env=environment)


def done(server, *arguments):
    result = run(server, *arguments)
    assert result.exit_code == 0, result.output
    return result.stdout


def refused(server, *arguments, key=KEY):
    result = run(server, *arguments, key=key)
    assert result.exit_code == 2, result.output
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("\n") == 1
    return result.stderr


@pytest.fixture
def scene(server, tmp_path):
    """The name of a scene that was uploaded."""
    done(server, "scenes", "download", "demo", "-o", tmp_path / "demo.ugr")
    yield done(server, "scenes", "upload", tmp_path / "demo.ugr", "--name", "mine", "--json") and "mine"
    done(server, "scenes", "delete", "mine")


def test_a_scene_goes_down_and_up_again(server, scene, tmp_path):
    assert read_header(tmp_path / "demo.ugr").info.gaussian_count == 400
    listed = json.loads(done(server, "scenes", "list", "--json"))
    assert {"demo", scene} <= {one["name"] for one in listed}
    assert "mine" in done(server, "scenes", "list")
    shown = json.loads(done(server, "scenes", "show", scene, "--json"))
    assert (shown["name"], shown["gaussian_count"]) == (scene, 400)
    assert "gaussian_count" in done(server, "scenes", "show", scene)
    assert "there is already a scene 'mine'" in refused(
        server, "scenes", "upload", tmp_path / "demo.ugr", "--name", scene
    )
    assert "demo.ugr exists: --force" in refused(server, "scenes", "download", scene, "-o", tmp_path / "demo.ugr")
    assert "there is no scene 'none'" in refused(server, "scenes", "download", "none", "-o", tmp_path / "none.ugr")
    assert not (tmp_path / "none.ugr").exists()
    done(server, "scenes", "download", scene, "-o", tmp_path / "demo.ugz")
    assert read_header(tmp_path / "demo.ugz").is_compressed


def test_a_frame_as_a_picture(server, tmp_path):
    picture = tmp_path / "frame.png"
    assert f"wrote {picture}: 1 frame of {HEIGHT}x{WIDTH}" in done(server, "scenes", "render", "demo", "-o", picture)
    assert cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE).shape == (HEIGHT, WIDTH)
    before = picture.read_bytes()
    assert "frame.png exists: --force" in refused(server, "scenes", "render", "demo", "-o", picture, "--gain-db", 20)
    done(server, "scenes", "render", "demo", "-o", picture, "--gain-db", 20, "--force")
    assert picture.read_bytes() != before


def test_a_sampler_makes_a_folder_of_pictures(server, tmp_path):
    folder = tmp_path / "pictures"
    sampled = ("--sampler", "training", "--height", 8, "--width", 8, "--outputs", "bmode,transmittance")
    document = json.loads(done(server, "scenes", "render", "demo", "-o", folder, *sampled, "--json"))
    assert (document["frames"], document["height"], document["width"]) == (5, 8, 8)
    assert len(list(folder.glob("frame_*_bmode.png"))) == len(list(folder.glob("frame_*_transmittance.png"))) == 5
    frames = json.loads((folder / "frames.json").read_text())
    assert [frame["frame"] for frame in frames] == [0, 1, 2, 3, 4]
    assert np.shape(frames[0]["pose"]) == (4, 4)
    assert "holds files" in refused(server, "scenes", "render", "demo", "-o", folder)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("-o", "f.png", "--sampler", "training"), "a picture holds one frame, there are 5 poses"),
        (("-o", "pictures", "--outputs", "labels"), "labels"),
    ],
)
def test_mistakes_leave_nothing(server, tmp_path, monkeypatch, arguments, told):
    monkeypatch.chdir(tmp_path)
    assert told in refused(server, "scenes", "render", "demo", *arguments)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def sweep(tmp_path):
    return noise_sweep(tmp_path / "tiny")


@pytest.mark.long
def test_a_folder_becomes_a_dataset(server, sweep):
    assert "uploaded tiny: 8 training and 2 held-out frames of 16x20" in done(server, "datasets", "upload", sweep)
    assert "tiny is there already, the same" in done(server, "datasets", "upload", sweep / "conf.json")
    record = json.loads(done(server, "datasets", "show", "tiny", "--json"))
    assert (record["kind"], record["train_frames"], record["private"]) == ("released", 8, False)
    named = ("datasets", "upload", sweep, "--name", "half", "--val-frames", "0:4", "--private")
    assert "uploaded half" in done(server, *named)
    listed = json.loads(done(server, "datasets", "list", "--json"))
    assert [(one["name"], one["val_frames"]) for one in listed] == [("half", 4), ("tiny", 2)]
    assert "(private)" in done(server, "datasets", "list")
    for name in ("tiny", "half"):
        assert done(server, "datasets", "delete", name) == f"{name} deleted\n"
    assert "tiny" in refused(server, "datasets", "show", "tiny")


def test_a_recording_is_shown_and_becomes_a_dataset_or_is_given_up(server, tmp_path):
    sweep = noise_sweep(tmp_path / "sweep")
    for name in ("kept", "given-up"):
        assert f"{name} is open, with 10 frames" in done(server, "live", sweep, name, "--open", "--speed", 1000)
        shown = json.loads(done(server, "recordings", "show", name, "--json"))
        assert (shown["name"], shown["frames"], shown["next_number"]) == (name, 10, 10)
    assert "next_number" in done(server, "recordings", "show", "kept")
    finished = done(server, "recordings", "finish", "kept")
    assert finished == "recorded kept: 8 training and 2 held-out frames\n"
    assert json.loads(done(server, "datasets", "show", "kept", "--json"))["train_frames"] == 8
    assert done(server, "recordings", "delete", "given-up") == "given-up deleted\n"
    assert done(server, "recordings", "finish", "kept") == finished  # for who did not hear the answer
    for command in ("show", "delete"):
        assert "there is no open recording 'kept'" in refused(server, "recordings", command, "kept")
    for command in ("show", "finish", "delete"):
        assert "there is no dataset 'given-up'" in refused(server, "recordings", command, "given-up")
    done(server, "datasets", "delete", "kept")


def test_the_port_of_grpc_is_told_from_that_of_http(server):
    told = refused(server, "scenes", "list", "--address", server.grpc)
    assert told.startswith(f"error: http://{server.grpc} does not speak HTTP; if it is the port of gRPC, give HTTP's")
    assert told.strip().isprintable()


def test_what_is_no_sweep_is_not_sent(server, tmp_path):
    (tmp_path / "notes.txt").write_text("nothing")
    assert "must hold a folder with conf.json" in refused(server, "datasets", "upload", tmp_path)
    (tmp_path / "a.zip").write_bytes(b"no zip at all")
    assert refused(server, "datasets", "upload", tmp_path / "a.zip")
    assert json.loads(done(server, "datasets", "list", "--json")) == []


def test_a_large_upload_that_is_refused_at_once_tells_why(server, tmp_path):
    large = tmp_path / "large.zip"
    with large.open("wb") as file:
        file.truncate(2**27)
    assert "API key" in refused(server, "datasets", "upload", large, key="wrong-key-0123456789")


def test_a_registration_goes_up_and_is_listed_shown_and_deleted(server, tmp_path):
    base_to_scene = np.eye(4)
    base_to_scene[:3, 3] = (1.0, 2.0, 3.0)
    flange = np.tile(np.eye(4), (3, 1, 1))
    flange[:, :3, 3] = np.diag([50.0, 60.0, 70.0])
    np.save(tmp_path / "flange.npy", flange)
    np.save(tmp_path / "probe.npy", base_to_scene @ flange)
    file = tmp_path / "robot.json"
    done(server, "calibrate", "poses", tmp_path / "flange.npy", tmp_path / "probe.npy", "-o", file)
    assert done(server, "registrations", "upload", file, "--scene", "demo") == "uploaded robot, of the scene demo\n"
    assert json.loads(done(server, "registrations", "upload", file, "--scene", "demo", "--json"))["name"] == "robot"
    done(server, "registrations", "upload", file, "--scene", "second", "--name", "other")
    assert [one["name"] for one in json.loads(done(server, "registrations", "list", "--json"))] == ["other", "robot"]
    assert "second" in done(server, "registrations", "list")
    shown = json.loads(done(server, "registrations", "show", "robot", "--json"))
    np.testing.assert_allclose(shown["base_to_scene"], base_to_scene, atol=1e-9)
    assert "base_to_scene" in done(server, "registrations", "show", "robot")
    for name in ("robot", "other"):
        assert done(server, "registrations", "delete", name) == f"{name} deleted\n"
    assert "there is no registration 'robot'" in refused(server, "registrations", "show", "robot")
    assert "there is no scene 'none'" in refused(server, "registrations", "upload", file, "--scene", "none")
    assert "is no registration" in refused(server, "registrations", "upload", tmp_path / "probe.npy", "--scene", "demo")

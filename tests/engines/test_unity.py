"""The component of the Unity package, compiled against a stand-in for UnityEngine, with frames of both origins."""

import json
import shutil

import httpx
import numpy as np
import pytest

from ultragray import GaussianScene
from ultragray.rendering.frames import render_shown
from ultragray.rendering.pixels import to_uint8
from ultragray.rendering.settings import Encoding, RenderSettings

from .conftest import ENGINES, HERE
from .test_csharp import free_port

UNITY = ENGINES / "unity"
TURN = (0.1, -0.2, 0.3)


@pytest.fixture(scope="module")
def unity(build, client):
    engine = build("UnityEngine.dll", [HERE / "UnityEngine.cs"])
    package = build("Ultragray.Unity.dll", sorted((UNITY / "Runtime").glob("*.cs")), [client, engine])
    build("Samples.dll", sorted((UNITY / "Samples~").rglob("*.cs")), [client, engine, package])
    return build("UnityDriver.exe", [HERE / "UnityDriver.cs"], [client, engine, package])


@pytest.fixture(scope="module")
def service(start_service):
    return start_service()


@pytest.fixture(params=["service", "file", "downloaded"])
def origin(request):
    """Where frames come from."""
    return request.param


@pytest.fixture
def program(origin, unity, start, service, data_folder, tmp_path):
    if origin == "service":
        return start(unity, "remote", service.http)
    if origin == "downloaded":
        return start(unity, "local", service.http)
    shutil.copy(data_folder / "demo.ugr", tmp_path / "liver.ugr")
    return start(unity, "local", "http://127.0.0.1:9", "liver.ugr", STREAMING_ASSETS=str(tmp_path))


def image_of(program):
    """The texture [H, W], its first row at the top, and the pose [4, 4] of its frame."""
    width, height, *texels = program.wait_for("image").split()
    image = np.array([int(one, 16) for one in texels], np.uint32).reshape(int(height), int(width))[::-1]
    grey = image & 255
    np.testing.assert_array_equal(image, 0xFF000000 | grey * 0x010101)
    return grey, np.array([float(one) for one in program.wait_for("pose").split()]).reshape(4, 4)


@pytest.fixture
def shown_scene(origin, demo_scene, tmp_path):
    """The demo scene, as it is downloaded: compressed."""
    if origin != "downloaded":
        return demo_scene
    demo_scene.save(tmp_path / "demo.ugz")
    return GaussianScene.load(tmp_path / "demo.ugz")


def test_the_texture_shows_what_the_probe_sees(origin, program, shown_scene):
    w = np.sqrt(1.0 - np.square(TURN).sum())
    program.say("patient", 0.5, 0.25, -0.125)
    program.say("probe", 0.501, 0.252, -0.122)
    program.say("turn", *TURN, w)
    program.say("until", 1)
    image, pose = image_of(program)
    np.testing.assert_allclose(pose[:3, 3], [1.0, -2.0, 3.0], atol=1e-3)
    x, y, z = -TURN[0], TURN[1], -TURN[2]
    np.testing.assert_allclose(
        pose[:3, 2], [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], atol=1e-6
    )
    settings = RenderSettings().resolved(shown_scene.info, Encoding.UINT8)
    expected = to_uint8(render_shown(shown_scene, settings, pose[None])["bmode"].numpy())[0]
    frames = 1
    while origin == "downloaded" and (image != expected).any():  # frames of a scene that has arrived in part
        frames += 1
        program.say("until", frames)
        image, _ = image_of(program)
    np.testing.assert_array_equal(image, expected)
    assert expected.any()
    # The upper left corner of the image is at x = -20 mm of the probe, on its face.
    scene_mm = (pose @ [-20.0, 0.0, 0.0, 1.0])[:3]
    corner = [float(one) for one in program.wait_for("corner").split()]
    np.testing.assert_allclose(corner, scene_mm * [1e-3, -1e-3, 1e-3] + [0.5, 0.25, -0.125], atol=1e-6)
    program.say("size", 30, 20)
    program.say("until", frames + 1)
    assert image_of(program)[0].shape == (30, 20)
    assert program.end()[-1] == "destroyed True"


def test_a_frame_leaves_no_garbage_on_the_thread_of_the_game(program):
    program.say("until", 1)
    program.say("garbage")
    assert program.wait_for("garbage") == "0"


def test_a_probe_that_does_not_move_asks_for_nothing(unity, start, service):
    program = start(unity, "remote", service.http)
    program.say("until", 1)
    program.wait_for("corner")
    program.say("updates", 50)
    program.wait_for("did updates")
    (stream,) = httpx.get(f"{service.http}/v1/streams").json()["streams"]
    assert (stream["name"], stream["poses"]) == ("Unity probe", 1)
    program.say("disable")
    program.say("enable")
    program.say("until", 2)
    program.wait_for("corner")


def test_the_image_goes_on_after_the_service_was_killed(unity, start, start_service):
    port = free_port()
    service = start_service(http_port=port)
    program = start(unity, "remote", service.http)
    program.say("until", 1)
    before, _ = image_of(program)
    service.process.kill()
    service.process.wait()
    program.say("problem")
    assert "is lost, and tried again" in program.wait_for("problem")
    program.say("probe", 0.003, 0, 0)
    program.say("until", 1)
    start_service(http_port=port)
    program.say("until", 2)
    program.wait_for("did until 1")
    after, pose = image_of(program)
    assert pose[0, 3] == pytest.approx(3.0)
    assert not np.array_equal(before, after)


def test_the_package_is_laid_out_as_unity_wants_it():
    for folder in (ENGINES / "csharp", UNITY):
        package = json.loads((folder / "package.json").read_text())
        assert package["name"].startswith("com.ultragray.")
        assert package["unity"] == "2021.3"
        for sample in package.get("samples", ()):
            assert (folder / sample["path"]).is_dir()
    client = json.loads((ENGINES / "csharp" / "package.json").read_text())
    assert package["dependencies"] == {client["name"]: client["version"]}
    definition = json.loads((UNITY / "Runtime" / "Ultragray.Unity.asmdef").read_text())
    assert definition["references"] == [json.loads((ENGINES / "csharp" / "Ultragray.asmdef").read_text())["name"]]

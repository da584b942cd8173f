"""The client in C# against a real service, and libultragray through it."""

import hashlib
import json
import socket
import subprocess
from pathlib import Path

import httpx
import numpy as np
import pytest
from websockets.sync.client import connect

from ultragray import GaussianScene
from ultragray.contract import from_dict, to_dict
from ultragray.geometry.pose import pose_from_position_quaternion
from ultragray.geometry.probe import Probe
from ultragray.phantom.demo import DEMO_FILE
from ultragray.rendering.settings import RenderSettings
from ultragray.rendering.tools import Tool

from ..client.proxy import Proxy
from ..model.library.test_library import Scene, loaded_library, of_python
from ..service.conftest import split
from .conftest import HERE

KEY = "0123456789abcdef-engines"


@pytest.fixture(scope="module")
def service(start_service):
    return start_service(api_keys=KEY)


def rendered(
    service, position=(0.0, 0.0, 0.0), quaternion=(1.0, 0.0, 0.0, 0.0), accept="application/octet-stream", **settings
):
    """The bytes of a frame as the service renders it over HTTP."""
    names = ("x", "y", "z"), ("w", "x", "y", "z")
    pose = {
        "position_mm": dict(zip(names[0], position, strict=True)),
        "quaternion": dict(zip(names[1], quaternion, strict=True)),
    }
    headers = {"Accept": accept, "X-API-Key": KEY}
    answer = httpx.post(
        f"{service.http}/v1/scenes/demo/render", json={"pose": pose, **settings}, headers=headers, timeout=300
    )
    assert answer.status_code == 200, answer.text
    return answer


def sha256(data):
    return hashlib.sha256(data).hexdigest()


def test_the_client_needs_no_type_beyond_net_standard(build, client):
    standard = Path("/usr/lib/mono/4.5/Facades/netstandard.dll")
    cecil = sorted(Path("/usr/lib/mono/gac/Mono.Cecil").glob("0.11*/Mono.Cecil.dll"))
    if not cecil or not standard.is_file():
        pytest.skip("there is no reader of assemblies (Debian's libmono-cecil-private-cil) or standard")
    types = build("Types.exe", [HERE / "Types.cs"], cecil[:1])
    told = subprocess.run(["mono", types, standard, client], check=True, capture_output=True, text=True).stdout
    assert told == "of 2715\n"  # types of .NET Standard 2.1 as Mono has it


def test_the_service_over_http(driver, start, service, demo_scene):
    told = start(driver, "service", service.http, KEY).end()
    assert told[0] == "scenes demo probeless second"
    assert told[1] == "scene 400 linear 40 5"
    file = httpx.get(f"{service.http}/v1/scenes/demo/file.ugz", headers={"X-API-Key": KEY})
    assert told[2] == f"file {sha256(file.content)}"
    needle = {"kind": "needle", "tip_mm": [0, 0, 20], "hub_mm": [-20, 0, 5], "frame": "probe"}
    asked = {"height": 40, "outputs": ["bmode", "coverage"], "tools": [needle]}
    answer = rendered(service, position=(0, 2, 0), accept="application/octet-stream;dtype=float32", **asked)
    confidence = json.loads(answer.headers["X-Ultragray-Extrapolation"])["confidence"]
    assert told[3] == f"frame bmode,coverage 40 48 {confidence or '-'} {sha256(answer.content)}"
    assert told[4] == "png PNG Png"
    assert told[5].startswith("refused ")
    assert "other" in told[5]


def test_what_is_wrong_is_told_in_a_sentence(driver, start, service):
    assert start(driver, "service", service.http, "wrong-key").end()[0].startswith("refused UNAUTHENTICATED")
    for scene, key, problem in (
        ("nope", KEY, "there is no scene 'nope'"),
        ("demo", "wrong-key", "key"),
        ("truncated", KEY, "cut off"),
    ):
        program = start(driver, "frames", "remote", service.http, scene, key)
        assert problem in program.wait_for("problem")
        program.end()
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{taken.getsockname()[1]}"
        assert (
            start(driver, "frames", "remote", address, "demo")
            .wait_for("problem")
            .startswith(f"no service answers at {address}")
        )


def test_frames_of_a_stream_are_those_that_the_service_renders(driver, start, service):
    program = start(driver, "frames", "remote", service.http, "demo", KEY)
    program.say("ask", 0.125, 0.1, 0.3)
    assert program.wait_for("frame", 1) == f"64 48 - {sha256(rendered(service, (0.125, 0.1, 0.3)).content)}"
    program.say("set", 50, 40, "Float32", "bmode,transmittance", 3)
    answer = rendered(
        service,
        (0.125, 0.1, 0.3),
        accept="application/octet-stream;dtype=float32",
        height=50,
        width=40,
        outputs=["bmode", "transmittance"],
        display={"gain_db": 3},
    )
    assert program.wait_for("frame", 2) == f"50 40 - {sha256(answer.content)}"
    turned = (0.9, 0.1, -0.3, 0.2)
    unit = tuple((np.array(turned) / np.linalg.norm(turned)).tolist())
    program.say("set", 50, 40, "Uint8", "bmode", 0)
    program.wait_for("frame", 3)
    program.say("ask", 1, 2, 3, *unit)
    assert (
        program.wait_for("frame", 4)
        == f"50 40 - {sha256(rendered(service, (1, 2, 3), unit, height=50, width=40).content)}"
    )
    program.end()


def test_a_refused_pose_or_setting_is_told_and_the_stream_goes_on(driver, start, service):
    program = start(driver, "frames", "remote", service.http, "demo", KEY)
    program.say("set", 0, 40, "Uint8", "bmode", 0)
    program.say("ask", 0, 0, 0)
    assert "height" in program.wait_for("problem")
    program.say("set", 50, 40, "Uint8", "bmode", 0)
    program.wait_for("well")
    program.say("ask", 0, 0, 0, 2, 0, 0, 0)
    assert "quaternion" in program.wait_for("problem")
    program.say("ask", 0, 0, 0)
    assert program.wait_for("frame").startswith("4 50 40 ")
    program.end()


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def test_a_stream_goes_on_after_the_service_was_killed(driver, start, start_service):
    port = free_port()
    service = start_service(http_port=port)
    program = start(driver, "frames", "remote", service.http, "demo")
    program.say("set", 50, 40, "Uint8", "bmode", 0)
    program.say("ask", 0, 0, 0)
    program.wait_for("frame", 1)
    service.process.kill()
    service.process.wait()
    assert program.wait_for("problem").startswith(f"the connection to {service.http} is lost, and tried again: ")
    assert program.wait_for("problem").startswith(f"no service answers at {service.http}: ")
    for x_mm in (1, 2, 3):
        program.say("ask", x_mm, 0, 0)
    again = start_service(http_port=port)
    assert program.wait_for("frame", 4) == f"50 40 - {sha256(rendered(again, (3, 0, 0), height=50, width=40).content)}"
    program.say("ask", 4, 0, 0)
    program.wait_for("frame", 5)
    assert [line.split()[1] for line in program.end() if line.startswith("frame")] == ["1", "4", "5"]


def test_a_frame_that_is_cut_in_the_middle_comes_again(driver, start, service):
    proxy = Proxy(service.http.removeprefix("http://"))
    program = start(driver, "frames", "remote", f"http://{proxy.address}", "demo", KEY)
    program.say("set", 400, 500, "Uint8", "bmode", 0)
    program.say("ask", 0, 0, 0)
    program.wait_for("frame", 1)
    proxy.cut_after(50_000)
    program.say("ask", 1, 0, 0)
    assert "is lost, and tried again" in program.wait_for("problem")
    assert (
        program.wait_for("frame", 2)
        == f"400 500 - {sha256(rendered(service, (1, 0, 0), height=400, width=500).content)}"
    )
    program.end()
    assert proxy.cuts == 1
    proxy.close()


def test_the_last_of_many_poses_gets_its_frame(driver, start, service):
    program = start(driver, "frames", "remote", service.http, "demo", KEY)
    for step in range(1, 301):
        program.say("ask", step / 100, 0, 0)
    assert program.wait_for("frame", 300) == f"64 48 - {sha256(rendered(service, (3, 0, 0)).content)}"
    program.end()


def test_a_stream_aligns_the_clocks(driver, start, service):
    program = start(driver, "frames", "remote", service.http, "demo", KEY)
    for number in (1, 2):
        program.say("ask", number, 0, 0)
        program.wait_for("frame", number)
    key = {"X-API-Key": KEY}
    (stream,) = httpx.get(f"{service.http}/v1/streams?scene=demo", headers=key).json()["streams"]
    watch = f"{service.http.replace('http', 'ws', 1)}/v1/streams/{stream['id']}/watch"
    with connect(watch, additional_headers=key, max_size=None) as watcher:
        program.say("ask", 3, 0, 0)
        header, _ = split(watcher.recv(timeout=300))
    assert header["clock"] is not None
    assert header["age_ms"] > 0.0
    program.end()


def held(program):
    """What the process held after a fifth of its frames, and after all: bytes, pages, descriptors, threads, garbage."""
    return np.array([[int(one) for one in program.wait_for("held").split()] for _ in range(2)])


@pytest.fixture(params=["remote", "local"])
def source(request, service, data_folder):
    return ("remote", service.http, "demo", KEY) if request.param == "remote" else ("local", data_folder / "demo.ugr")


def test_a_frame_leaves_no_garbage_on_the_thread_that_takes_it(driver, start, source):
    program = start(driver, "many", *source, 200)
    _, (*_, garbage) = held(program)
    assert garbage == 0
    program.end()


@pytest.mark.long
def test_ten_thousand_frames_leave_nothing(driver, start, source):
    program = start(driver, "many", *source, 10_000)
    first, last = held(program)
    program.end()
    assert last[1] - first[1] < 100_000  # bytes, of some 5 MB
    assert last[2] < 1.05 * first[2]  # pages
    assert last[3] <= first[3] + 1
    assert last[5] == 0


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({}, None),
        (
            {
                "height": 90,
                "width": 75,
                "encoding": "float32",
                "outputs": ["bmode", "labels", "coverage"],
                "display": {"gain_db": 3.0},
            },
            "90 75 Float32 bmode,labels,coverage 3",
        ),
        (
            {"height": 100, "width": 130, "encoding": "uint8", "outputs": ["echo"], "display": {"gain_db": -2.0}},
            "100 130 Uint8 echo -2",
        ),
    ],
)
def test_local_frames_are_those_of_python_byte_for_byte(driver, start, settings, words):
    program = start(driver, "frames", "local", DEMO_FILE)
    if words:
        program.say("set", words)
    turned = (0.9, 0.1, -0.3, 0.2)
    unit = (np.array(turned) / np.linalg.norm(turned)).tolist()
    program.say("ask", 3, -4, 1, *unit)
    height, width, confidence, sum_ = program.wait_for("frame", 1).split()
    program.end()
    pose = pose_from_position_quaternion((3, -4, 1), unit)
    shown, (extrapolation,) = of_python(GaussianScene.load(DEMO_FILE), settings, pose[None])
    assert sum_ == sha256(b"".join(one.tobytes() for one in shown.values()))
    assert (1, int(height), int(width)) == next(iter(shown.values())).shape
    assert float(confidence) == pytest.approx(extrapolation.confidence)


def test_a_compressed_scene_is_rendered_while_it_arrives(driver, start, tmp_path):
    file, damaged = tmp_path / "demo.ugz", tmp_path / "damaged.ugz"
    GaussianScene.load(DEMO_FILE).save(file)
    data = file.read_bytes()
    begun = len(data) // 2  # within the third of four parts
    damaged.write_bytes(data[:-100] + bytes([data[-100] ^ 1]) + data[-99:])
    held = [Scene(loaded_library(), data[:end], "load_part") for end in (begun, len(data) - 1)]
    held.append(Scene(loaded_library(), data))
    two, three, four = (sha256(one.render({}, np.eye(4)[None])[1].tobytes()) for one in held)
    assert len({two, three, four}) == 3
    for name, problem, last in ((file, "", four), (damaged, "its part.03 is damaged: its checksum differs", three)):
        program = start(driver, "frames", "arriving", name, begun)
        program.say("ask", 0, 0, 0)
        while not program.wait_for("frame").endswith(two):  # but that of one part
            pass
        program.say("rest")
        awaited = {("frame", last), ("whole", problem)}  # in any order
        while awaited:
            line = program.next_line()
            awaited -= {(begin, end) for begin, end in awaited if line.startswith(begin) and line.endswith(end)}
        program.end()


def test_what_is_wrong_with_local_frames_is_told_in_a_sentence(driver, start, tmp_path):
    for file, problem in (
        (DEMO_FILE.read_bytes()[:1000], "cut off"),
        (b"\x89PNG no scene", "damaged, or a file of another kind"),
    ):
        (tmp_path / "file").write_bytes(file)
        assert problem in start(driver, "frames", "local", tmp_path / "file").wait_for("problem")
    assert "Could not find file" in start(driver, "frames", "local", tmp_path / "none").wait_for("problem")
    program = start(driver, "frames", "local", DEMO_FILE)
    program.say("ask", 0, 0, 0, 0, 0, 0, 0)
    assert program.wait_for("problem") == "poses[0] must be finite, got NaN or infinity"
    program.say("ask", 0, 0, 0)
    program.wait_for("frame", 2)
    program.say("set", 0, 40, "Uint8", "bmode", 0)
    assert program.wait_for("problem") == "height must be an integer from 1 to 4096, got 0"
    program.end()


@pytest.mark.parametrize("kind", Probe.members)
def test_settings_are_read_and_written_as_the_service_does(driver, kind):
    """Those of a frame's header, with each kind of tool and a text that has to be escaped."""
    settings = {
        "probe": {"kind": kind, **Probe.members[kind].example()},
        "tools": [{"kind": one, **cls.example()} for one, cls in Tool.members.items()],
        "display": {"gain_db": 3.5, "tgc_db": [0.0, 2.0, -1.5], "flip": True, "depth_mm": 30.0},
        "min_confidence": 0.25,
        "below_min_confidence": "mask",
        "contact": "pressure",
        "ghost": 0.125,
        "speckle": "natural",
        "slice_thickness_mm": 1.5,
        "outputs": ["bmode", "coverage"],
        "encoding": "float16",
        "registration": 'arm "ü" \\ 7\n',
        "height": 123,
        "width": 45,
    }
    asked = from_dict(RenderSettings, settings)
    document = to_dict(asked)
    header = document | {
        "rendered_height": document.pop("height"),
        "rendered_width": document.pop("width"),
        "height": 1,
        "width": 2,
        "renderer": "ultragray/0.1.0",
        "pose": np.eye(4).tolist(),
        "extrapolation": {"confidence": None, "distance_mm": 1e-7},
        "new in a later version": [{"a": [1, "]"]}, None, True],
    }
    ran = subprocess.run(["mono", driver, "again"], input=json.dumps(header), capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    assert from_dict(RenderSettings, json.loads(ran.stdout)) == asked


@pytest.mark.parametrize("seed", range(3))
def test_unity_is_left_handed_and_in_metres(driver, seed):
    """A point of the probe is the same place in the room, whichever of the two leads it there."""
    random = np.random.default_rng(seed)
    position, turn = random.normal(size=3), random.normal(size=4)
    turn /= np.linalg.norm(turn)
    words = [repr(float(one)) for one in (*position, *turn)]
    ran = subprocess.run(["mono", driver, "pose", *words], capture_output=True, text=True, check=True)
    matrix, back = (np.array([float(one) for one in line.split()]) for line in ran.stdout.splitlines())
    matrix = matrix.reshape(4, 4)
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-6)
    assert np.linalg.det(matrix[:3, :3]) > 0
    x, y, z, w = turn
    # Unity's rotation of a vector, by its own components: v + 2w(q x v) + 2q x (q x v)
    point = random.normal(size=3)  # of the probe, metres in Unity's axes
    q = np.array([x, y, z])
    turned = point + 2 * w * np.cross(q, point) + 2 * np.cross(q, np.cross(q, point))
    mirror = np.array([1000.0, -1000.0, 1000.0])
    np.testing.assert_allclose(
        matrix[:3, :3] @ (mirror * point) + matrix[:3, 3], mirror * (turned + position), atol=1e-2
    )
    np.testing.assert_allclose(back, [*position, x, y, z, w], atol=1e-6)

"""Tools and ghosts through each front door: the library's own frames, told so that each can be rendered again."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import numpy as np
import pytest
from websockets.sync.client import connect

import ultragray_client
from ultragray import GaussianScene, render
from ultragray.contract import to_dict
from ultragray.rendering.pixels import to_uint8
from ultragray.rendering.settings import FrameSettings
from ultragray.rendering.tools import MAX_TOOLS, Box, Cylinder, Needle, Tool, ToolFrame
from ultragray_client.contract import RenderSettings
from ultragray_client.errors import InvalidArgument, UnknownOutput

from .conftest import HEIGHT, WIDTH, RunningService

POSE = np.eye(4)
POSE[:3, 3] = 1.0, 2.0, -0.5
NEEDLE = Needle(tip_mm=(8.0, 2.0, 25.0), hub_mm=(-15.0, 2.0, 5.0), label=3)
BOX = Box(centre_mm=(2.0, 0.0, 18.0), size_mm=(6, 4, 2), quaternion=(0.9961947, 0.0, 0.0871557, 0.0), frame="probe")  # type: ignore[arg-type]
ROD = Cylinder(tip_mm=(-5.0, -9.0, 12.0), hub_mm=(-5.0, 9.0, 14.0), diameter_mm=3.0, opacity=0.0)
TOOLS: dict[str, tuple[Tool, ...]] = {"none": (), "needle": (NEEDLE,), "all": (BOX, NEEDLE, ROD)}
OUTPUTS = ("bmode", "echo", "transmittance", "labels")
RAW = {"Accept": "application/octet-stream"}


@pytest.fixture(scope="module")
def tool_service(
    start_service: Callable[..., RunningService], demo_scene: GaussianScene, tmp_path_factory: Any
) -> RunningService:
    folder = tmp_path_factory.mktemp("tools")
    demo_scene.save(folder / "scene.ugr")
    return start_service(data_folder=folder, artifact_folder=tmp_path_factory.mktemp("artifacts"))


@pytest.fixture(scope="module")
def http(tool_service: RunningService) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=f"{tool_service.http}/v1/", timeout=60) as client:
        yield client


def expected(
    scene: GaussianScene, tools: tuple[Tool, ...], ghost: float = 0.0, output: str = "bmode"
) -> np.ndarray:  # [H, W] float32, labels uint8
    asked = {"height": HEIGHT, "width": WIDTH, "outputs": (output,)}
    found: np.ndarray = render(scene, None, POSE, **asked, tools=tools, ghost=ghost)[output][0].numpy()
    return found


def body(tools: tuple[Tool, ...], ghost: float = 0.0, **more: Any) -> dict[str, Any]:
    asked = {"tools": to_dict(tools)} if tools else {}
    return {"pose": {"matrix": POSE.tolist()}, **asked, **({"ghost": ghost} if ghost else {}), **more}


def told(answer: httpx.Response) -> dict[str, Any]:
    """The settings that an answer of HTTP tells beside the pixels."""
    headers = answer.headers
    return {
        "pose": {"matrix": json.loads(headers["X-Ultragray-Pose"])},
        "tools": json.loads(headers.get("X-Ultragray-Tools", "[]")),
        "ghost": float(headers.get("X-Ultragray-Ghost", 0.0)),
        "dtype": headers["X-Ultragray-Dtype"],
        "outputs": headers["X-Ultragray-Outputs"].split(","),
    }


@pytest.mark.parametrize("name", TOOLS)
@pytest.mark.parametrize("ghost", [0.0, 0.5])
def test_frames_over_http_are_the_librarys_and_can_be_rendered_again(
    http: httpx.Client, demo_scene: GaussianScene, name: str, ghost: float
) -> None:
    answer = http.post("scenes/scene/render", json=body(TOOLS[name], ghost), headers=RAW)
    assert answer.status_code == 200, answer.text
    assert answer.content == to_uint8(expected(demo_scene, TOOLS[name], ghost)).tobytes()
    assert ("X-Ultragray-Tools" in answer.headers) == bool(TOOLS[name])
    assert ("X-Ultragray-Ghost" in answer.headers) == bool(ghost)
    again = http.post("scenes/scene/render", json=told(answer), headers=RAW)
    assert again.content == answer.content
    assert told(again) == told(answer)


def test_frames_over_grpc_are_the_librarys_and_can_be_rendered_again(
    tool_service: RunningService, demo_scene: GaussianScene
) -> None:
    with ultragray_client.Client(tool_service.grpc) as client:
        needle = ultragray_client.Needle(tip_mm=(8, 2, 25), hub_mm=(-15, 2, 5), label=3)
        box = ultragray_client.Box(
            centre_mm=(2.0, 0.0, 18.0),
            size_mm=(6, 4, 2),
            quaternion=BOX.quaternion,
            frame=ultragray_client.ToolFrame.PROBE,
        )
        rod = ultragray_client.Cylinder(tip_mm=ROD.tip_mm, hub_mm=ROD.hub_mm, diameter_mm=3.0, opacity=0.0)
        for tools, own in (((), ()), ((needle,), (NEEDLE,)), ((box, needle, rod), (BOX, NEEDLE, ROD))):
            settings = RenderSettings(
                tools=tools, ghost=0.5, encoding=ultragray_client.Encoding.FLOAT32, outputs=("bmode",)
            )
            frame = client.render("scene", POSE, settings)
            assert frame["bmode"].tobytes() == expected(demo_scene, own, 0.5).tobytes()
            assert [vars(one) for one in frame.tools] == [vars(one) for one in own]
            assert frame.ghost == 0.5
            replayed = RenderSettings(tools=frame.tools, ghost=frame.ghost, encoding=settings.encoding)
            assert client.render("scene", frame.pose, replayed)["bmode"].tobytes() == frame["bmode"].tobytes()
        assert client.render("scene", POSE).tools == ()
        assert client.render("scene", POSE).ghost == 0.0


def test_a_stream_moves_a_needle_with_its_settings(tool_service: RunningService, demo_scene: GaussianScene) -> None:
    address = f"{tool_service.http.replace('http', 'ws', 1)}/v1/scenes/scene/stream"
    with connect(address, compression=None) as connection:
        for step in range(3):
            tools = (Needle(tip_mm=(step, 2.0, 20.0 + step), hub_mm=(-15.0, 2.0, 5.0)),)
            settings = {"encoding": "float32", "tools": to_dict(tools), "outputs": OUTPUTS}
            connection.send(json.dumps({"settings": settings, "pose": {"matrix": POSE.tolist()}}))
            message = connection.recv()
            assert isinstance(message, bytes), message
            length = 4 + int.from_bytes(message[:4], "little")
            header = json.loads(message[4:length])
            assert header["tools"] == to_dict(tools)
            assert header["ghost"] == 0.0
            pixels = np.frombuffer(message[length:], "<f4").reshape(len(OUTPUTS), HEIGHT, WIDTH)
            for name, plane in zip(OUTPUTS, pixels, strict=True):
                np.testing.assert_allclose(plane, expected(demo_scene, tools, output=name), atol=1e-6, err_msg=name)


def test_frames_asked_for_at_once_keep_their_own_tools(http: httpx.Client, demo_scene: GaussianScene) -> None:
    tools = [(Needle(tip_mm=(5.0, 2.0, 10.0 + place), hub_mm=(-15.0, 2.0, 5.0)),) for place in range(12)]

    def ask(own: tuple[Tool, ...]) -> bytes:
        return http.post("scenes/scene/render", json=body(own), headers=RAW).content

    with ThreadPoolExecutor(len(tools)) as threads:
        found = list(threads.map(ask, tools))
    for pixels, own in zip(found, tools, strict=True):
        assert pixels == to_uint8(expected(demo_scene, own)).tobytes()


def test_archives_hold_the_labels_of_tools(http: httpx.Client, demo_scene: GaussianScene) -> None:
    asked = body(TOOLS["all"], outputs=list(OUTPUTS))
    poses = {"poses": [asked.pop("pose"), {"matrix": np.eye(4).tolist()}]}
    answer = http.post("scenes/scene/render", json=asked | poses, headers={"Accept": "application/x-npz"})
    with np.load(io.BytesIO(answer.content)) as archive:
        for name in OUTPUTS:
            np.testing.assert_allclose(archive[name][0], expected(demo_scene, TOOLS["all"], output=name), atol=1e-6)
        assert {3, 255} <= set(np.unique(archive["labels"]).tolist())


@pytest.mark.parametrize(
    ("tools", "field", "words"),
    [
        ([{"kind": "drill"}], "tools[0].kind", "must be one of box, cylinder, needle"),
        ([{"kind": "needle", "tip_mm": [0, 0, 1]}], "tools[0].hub_mm", "is required"),
        ([{"kind": "needle", "tip_mm": [0, 0, 1], "hub_mm": [0, 0, 1]}], "tools[0].hub_mm", "must differ"),
        ([{"kind": "needle", "tip_mm": [0, 0], "hub_mm": [0, 0, 1]}], "tools[0].tip_mm", "tools[0].tip_mm"),
        ([to_dict(NEEDLE)] * (MAX_TOOLS + 1), "tools", f"at most {MAX_TOOLS}"),
        ([to_dict(NEEDLE) | {"opacity": 2.0}], "tools[0].opacity", "from 0 to 0.999"),
        ([None], "tools[0]", "tools[0]"),
    ],
)
def test_what_is_no_tool_is_refused(http: httpx.Client, tools: list[Any], field: str, words: str) -> None:
    answer = http.post("scenes/scene/render", json=body(()) | {"tools": tools})
    assert answer.status_code == 422
    assert answer.json()["field"].startswith(field)
    assert words in answer.json()["detail"]


def test_refusals_of_grpc_name_the_tool(tool_service: RunningService) -> None:
    same = ultragray_client.Needle(tip_mm=(0, 0, 1), hub_mm=(0, 0, 1))
    with ultragray_client.Client(tool_service.grpc) as client:
        with pytest.raises(InvalidArgument, match=r"tools\[1\].*hub_mm must differ"):
            client.render(
                "scene", POSE, RenderSettings(tools=(ultragray_client.Needle(tip_mm=(0, 0, 1), hub_mm=(1, 0, 1)), same))
            )
        with pytest.raises(InvalidArgument, match="ghost"):
            client.render("scene", POSE, RenderSettings(ghost=1.5))
        with pytest.raises(UnknownOutput, match="labels"):
            client.render("scene", POSE, RenderSettings(outputs=("labels",)))


def test_render_jobs_make_labelled_frames(
    http: httpx.Client, demo_scene: GaussianScene, tmp_path_factory: pytest.TempPathFactory
) -> None:
    specification = {
        "scene": "scene",
        "poses": [POSE.tolist()],
        "tools": to_dict(TOOLS["all"]),
        "ghost": 0.25,
        "outputs": ["bmode", "labels"],
        "dtype": "float32",
    }
    taken = http.post("jobs", json={"kind": "render", "specification": specification}).json()
    assert taken["specification"]["tools"] == to_dict(TOOLS["all"])
    refused = http.post(
        "jobs", json={"kind": "render", "specification": specification | {"tools": [{"kind": "saw"}]}}
    ).json()
    assert refused["field"] == "specification.tools[0].kind"


def test_settings_without_tools_are_as_they_were() -> None:
    assert set(to_dict(FrameSettings(), with_none=False)) == {"below_min_confidence", "outputs"}
    assert ToolFrame(BOX.frame) is ToolFrame.PROBE

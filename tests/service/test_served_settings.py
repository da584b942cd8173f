"""Settings of frames through each front door.

What a setting does to pixels is the library's, and how it is written is the codec's. Here each setting is rendered over
HTTP as the library renders it, and rendered again from what the answer tells; the other doors give the same pixels and
tell the same settings.
"""

import io
import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import grpc
import numpy as np
import pytest
import torch
from websockets.sync.client import connect

from ultragray import (
    ConvexProbe,
    ElevationBeam,
    GaussianScene,
    PhasedProbe,
    RadialProbe,
    SceneInfo,
    SteeredProbe,
    render,
)
from ultragray.contract import from_dict, to_dict
from ultragray.rendering.display import Display
from ultragray.rendering.frames import show
from ultragray.rendering.settings import Contact, RenderSettings
from ultragray.rendering.tools import MAX_TOOLS, Box, Cylinder, Needle
from ultragray.scene.modes import Mode, Motion, Moving
from ultragray.scene.speckle import BANDS, LEVELS, SpeckleModel
from ultragray_proto.codec import to_message
from ultragray_proto.v1 import geometry_pb2, rendering_pb2, scenes_pb2, scenes_pb2_grpc
from ultragray_service.igtl.contents import unpack_image

from .conftest import DEMO_PROBE, make_scene, split
from .igtl.conftest import Peer, address_of

HEIGHT, WIDTH = 40, 32
BEAM = ElevationBeam(thickness_mm=3.0, focus_mm=15.0, depth_of_field_mm=20.0)
NAMES = {1: "bone", 200: "vessel"}
ANGLE = np.radians(12.0)
POSE = np.array(
    [
        [np.cos(ANGLE), 0.0, -np.sin(ANGLE), 1.0],
        [0.0, 1.0, 0.0, 2.0],
        [np.sin(ANGLE), 0.0, np.cos(ANGLE), -0.5],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
POSE_BODY = {"matrix": POSE.tolist()}
NEEDLE = Needle(tip_mm=(8.0, 2.0, 25.0), hub_mm=(-15.0, 2.0, 5.0), label=3)
BOX = Box(centre_mm=(2.0, 0.0, 18.0), size_mm=(6, 4, 2), quaternion=(0.9961947, 0.0, 0.0871557, 0.0), frame="probe")
ROD = Cylinder(tip_mm=(-5.0, -9.0, 12.0), hub_mm=(-5.0, 9.0, 14.0), diameter_mm=3.0, opacity=0.0)
TOOLS = (BOX, NEEDLE, ROD)
FAN = ConvexProbe(opening_angle_deg=50.0, near_mm=20.0, far_mm=60.0)
PROBES = (
    FAN,
    PhasedProbe(opening_angle_deg=80.0, far_mm=40.0),
    RadialProbe(near_mm=1.0, far_mm=30.0),
    SteeredProbe(40.0, 25.0, near_mm=0.0, far_mm=40.0),
)
SPECKLE = SpeckleModel(
    seed=3,
    axial_mm=(0.8,) * BANDS,
    lateral_mm=(1.0,) * BANDS,
    elevation_mm=(1.0,) * BANDS,
    cell_mm=(2.0, 1.3, 1.6),
    strength=(0.1,) * LEVELS,
)
DISPLAY = Display(gain_db=6.0, dynamic_range_db=50.0, tgc_db=(0.0, 3.0), depth_mm=25.0, flip=True, pixel_mm=0.9)
RAW, NPZ = {"Accept": "application/octet-stream"}, {"Accept": "application/x-npz"}

# What is asked for beside the defaults, and how the library is asked for the same.
CASES = {
    "defaults": ({}, {}),
    "air": ({"contact": "air"}, {"contact": Contact.AIR}),
    "pressure": ({"contact": "pressure"}, {"contact": Contact.PRESSURE}),
    "indentation": (
        {"contact": "pressure", "indentation_mm": 3.0},
        {"contact": Contact.PRESSURE, "indentation_mm": 3.0},
    ),
    "a plane": ({"slice_thickness_mm": 0.0}, {"beam": ElevationBeam(0.0)}),
    "a thick slice": ({"slice_thickness_mm": 6.0}, {"beam": replace(BEAM, thickness_mm=6.0)}),
    "tools": ({"tools": to_dict(TOOLS)}, {"tools": TOOLS}),
    "a needle and a ghost": ({"tools": to_dict((NEEDLE,)), "ghost": 0.5}, {"tools": (NEEDLE,), "ghost": 0.5}),
    "natural speckle": ({"speckle": "natural"}, {"speckle": "natural"}),
    "a phase": ({"phase": [0.75]}, {"phase": (0.75,)}),
    "labels": ({"outputs": ["labels", "bmode"], "tools": to_dict(TOOLS)}, {"tools": TOOLS}),
    "display": ({"probe": to_dict(FAN), "display": to_dict(DISPLAY)}, {"probe": FAN, "display": DISPLAY}),
    **{one.kind: ({"probe": to_dict(one)}, {"probe": one}) for one in PROBES},
}
EACH = pytest.mark.parametrize("name", CASES)


@pytest.fixture(scope="module")
def scene():
    plain = make_scene(probe=DEMO_PROBE)
    labels = torch.tensor([0, 1, 200, 200], dtype=torch.uint8).repeat(100)
    info = SceneInfo(centre_mm=plain.info.centre_mm, probe=DEMO_PROBE, beam=BEAM, label_names=NAMES, speckle=SPECKLE)
    fields = np.zeros((1, 4, 4, 4, 3), np.float32)
    fields[..., 2], fields[..., 1] = 8.0, np.linspace(-3.0, 3.0, 4)
    moving = Moving(Motion((Mode("breathing", 0.0, 1.0),), (-40.0,) * 3, (30.0,) * 3), fields)
    poses = plain.training_poses
    return GaussianScene.from_splats(plain.splats, info=info, labels=labels, training_poses=poses, moving=moving)


@pytest.fixture(scope="module")
def service(start_service, scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("settings")
    scene.save(folder / "rich.ugr")
    replace(make_scene(20, probe=DEMO_PROBE), training_poses=np.zeros((0, 4, 4))).save(folder / "poor.ugr")
    return start_service(
        data_folder=folder, artifact_folder=tmp_path_factory.mktemp("artifacts"), igtl_port=0, igtl_slice_thickness_mm=6
    )


def expected(scene, name):  # [outputs, H, W]
    asked, options = CASES[name]
    options = {"probe": None, "beam": BEAM, **options}
    probe, display = options.pop("probe"), options.pop("display", None)
    scene = scene.at_phase(options.pop("phase")) if "phase" in options else scene
    outputs = tuple(asked.get("outputs", ["bmode"]))
    frames = render(scene, probe, POSE, height=HEIGHT, width=WIDTH, outputs=outputs, **options)
    planes = {output: frames[output] for output in outputs}
    if display is not None:
        planes = show(planes, probe, display)
    return np.stack([planes[output][0].numpy().astype(np.float32) for output in outputs])


def body(asked, **more):
    return {"pose": POSE_BODY, "height": HEIGHT, "width": WIDTH, "dtype": "float32", **asked, **more}


def told(headers):
    """The settings that an answer of HTTP tells beside the pixels, as they are asked for."""
    return {
        "pose": {"matrix": json.loads(headers["X-Ultragray-Pose"])},
        "probe": json.loads(headers["X-Ultragray-Probe"]),
        "slice_thickness_mm": float(headers["X-Ultragray-Slice-Thickness-Mm"]),
        "contact": headers.get("X-Ultragray-Contact"),
        "tools": json.loads(headers.get("X-Ultragray-Tools", "[]")),
        "ghost": float(headers.get("X-Ultragray-Ghost", 0.0)),
        "speckle": headers.get("X-Ultragray-Speckle", "off"),
        **{
            setting: json.loads(headers[header])
            for setting, header in (("indentation_mm", "X-Ultragray-Indentation-Mm"), ("phase", "X-Ultragray-Phase"))
            if header in headers
        },
        "dtype": headers["X-Ultragray-Dtype"],
        "outputs": headers["X-Ultragray-Outputs"].split(","),
    }


def message_of(asked):
    given = {"height": HEIGHT, "width": WIDTH, "encoding": "float32", **asked}
    return to_message(from_dict(RenderSettings, given), rendering_pb2.RenderSettings, scene="rich")


def pose_message():
    return geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=POSE.ravel().tolist()))


def test_the_settings_make_a_difference(scene):
    bmode = {name: expected(scene, name)[-1] for name in CASES if "probe" not in CASES[name][0]}
    for name, frame in bmode.items():
        assert name == "defaults" or np.abs(frame - bmode["defaults"]).max() > 0.05, name


@EACH
def test_http_has_the_pixels_of_the_library_and_tells_how_to_render_them_again(http, scene, name):
    asked, _ = CASES[name]
    answer = http.post("/v1/scenes/rich/render", json=body(asked), headers=RAW)
    assert answer.status_code == 200, answer.text
    truth = expected(scene, name)
    assert answer.headers["X-Ultragray-Shape"] == f"{len(truth)},1,{truth.shape[1]},{truth.shape[2]}"
    np.testing.assert_allclose(np.frombuffer(answer.content, "<f4").reshape(truth.shape), truth, atol=1e-5)
    facts = told(answer.headers)
    assert {key: facts[key] for key in asked if key in facts} == {key: asked[key] for key in asked if key in facts}
    again = http.post(
        "/v1/scenes/rich/render",
        json=body({}, **facts, **({"display": asked["display"]} if "display" in asked else {})),
        headers=RAW,
    )
    assert again.content == answer.content
    assert told(again.headers) == facts


@EACH
def test_the_other_doors_give_the_same(service, renders, scene, name):
    asked, _ = CASES[name]
    truth = expected(scene, name)
    frame = renders.Render(rendering_pb2.RenderRequest(settings=message_of(asked), pose=pose_message()), timeout=300)
    np.testing.assert_allclose(np.frombuffer(frame.data, "<f4").reshape(truth.shape), truth, atol=1e-5)
    wanted = message_of(asked)
    for field in ("probe", "contact", "tools", "ghost", "phase", "speckle", "display"):
        if field in asked:
            assert getattr(frame, field) == getattr(wanted, field)
    with connect(service.stream_url("rich"), compression=None) as stream:
        settings = {"height": HEIGHT, "width": WIDTH, "encoding": "float32", **asked}
        stream.send(json.dumps({"settings": settings, "pose": POSE_BODY}))
        answer = stream.recv(timeout=300)
    header, pixels = split(answer)
    assert pixels == frame.data
    assert {key: header[key] for key in asked} == asked
    assert (header["rendered_height"], header["rendered_width"]) == (HEIGHT, WIDTH)


def test_openigtlink_has_the_thickness_of_its_setting(service, scene):
    peer = Peer(address_of(service))
    peer.send_pose(POSE, "rich", version=2)
    message = peer.receive()
    peer.socket.close()
    assert message.metadata["slice_thickness_mm"] == "6.0"
    pixels = unpack_image(message.content).pixels
    height, width = pixels.shape
    beam = replace(BEAM, thickness_mm=6.0)
    truth = render(scene, None, POSE, height=height, width=width, outputs=("bmode",), beam=beam).bmode
    np.testing.assert_allclose(pixels / 255.0, truth[0].numpy(), atol=1.0 / 255.0)  # the pose came as float32


@pytest.mark.parametrize("count", [2, 9, 40])  # in one part, and in several that are packed together
def test_archives_hold_every_pose(http, scene, count):
    asked = body({"tools": to_dict(TOOLS), "contact": "air", "outputs": ["bmode", "labels"]})
    del asked["pose"]
    poses = [{"matrix": np.eye(4).tolist()}] * (count - 1) + [POSE_BODY]
    answer = http.post("/v1/scenes/rich/render", json={**asked, "poses": poses}, headers=NPZ)
    frames = render(
        scene,
        None,
        np.stack([np.eye(4), POSE]),
        height=HEIGHT,
        width=WIDTH,
        outputs=("bmode", "labels"),
        beam=BEAM,
        tools=TOOLS,
        contact=Contact.AIR,
    )
    with np.load(io.BytesIO(answer.content)) as archive:
        assert (archive["labels"].dtype, archive["bmode"].dtype) == (np.uint8, np.float32)
        for place, truth in ((0, 0), (-1, 1)):
            np.testing.assert_allclose(archive["bmode"][place], frames["bmode"][truth], atol=1e-5)
            np.testing.assert_array_equal(archive["labels"][place], frames["labels"][truth])
        assert {3, 255} <= set(np.unique(archive["labels"]).tolist())
        np.testing.assert_allclose(archive["contact_share"][[0, -1]], frames.touch.shares)


def test_frames_asked_for_at_once_keep_their_own_tools(http, scene):
    needles = [Needle(tip_mm=(5.0, 2.0, 10.0 + place), hub_mm=(-15.0, 2.0, 5.0)) for place in range(12)]

    def ask(needle):
        return http.post("/v1/scenes/rich/render", json=body({"tools": to_dict((needle,))}), headers=RAW).content

    with ThreadPoolExecutor(len(needles)) as threads:
        found = list(threads.map(ask, needles))
    for pixels, needle in zip(found, needles, strict=True):
        truth = render(scene, None, POSE, height=HEIGHT, width=WIDTH, outputs=("bmode",), beam=BEAM, tools=(needle,))
        np.testing.assert_allclose(np.frombuffer(pixels, "<f4").reshape(HEIGHT, WIDTH), truth["bmode"][0], atol=1e-5)


REFUSALS = [
    ({"slice_thickness_mm": 101.0}, "slice_thickness_mm", "to 100"),
    ({"tools": [{"kind": "needle", "tip_mm": [0, 0, 1], "hub_mm": [0, 0, 1]}]}, "tools[0].hub_mm", "must differ"),
    ({"tools": [to_dict(NEEDLE)] * (MAX_TOOLS + 1)}, "tools", f"at most {MAX_TOOLS}"),
    ({"display": {"pixel_mm": 0.001}}, "display.pixel_mm", "pixels of 0.001 mm"),
]


@pytest.mark.parametrize(("asked", "field", "words"), REFUSALS, ids=[field for _, field, _ in REFUSALS])
def test_what_cannot_be_rendered_is_refused(http, asked, field, words):
    answer = http.post("/v1/scenes/rich/render", json=body(asked))
    assert (answer.status_code, answer.json()["field"]) == (422, field), answer.text
    assert words in answer.json()["detail"]
    if "display" not in asked:  # which is the viewer's, not the frame's
        specification = {"scene": "rich", "poses": [POSE.tolist()], **asked}
        refused = http.post("/v1/jobs", json={"kind": "render", "specification": specification}).json()
        assert refused["field"] == f"specification.{field}"


def test_the_other_doors_refuse_by_name(service, renders):
    same = geometry_pb2.Tool(
        needle=geometry_pb2.Needle(**dict.fromkeys(("tip_mm", "hub_mm"), geometry_pb2.Position(z=1.0)))
    )
    settings = rendering_pb2.RenderSettings(scene="rich", tools=[same])
    with pytest.raises(grpc.RpcError, match=r"tools\[0\].*hub_mm must differ"):
        renders.Render(rendering_pb2.RenderRequest(settings=settings, pose=pose_message()))
    with connect(service.stream_url("rich")) as stream:
        stream.send(json.dumps({"settings": {"display": {"flip": 1}}}))
        assert json.loads(stream.recv(timeout=300))["error"]["field"] == "settings.display.flip"


def test_a_scene_without_what_a_setting_needs_refuses_it(http):
    for asked, field, words in (
        ({"contact": "air"}, "contact", "knows its training poses"),
        ({"speckle": "natural"}, "speckle", "fitted the speckle of its frames"),
        ({"outputs": ["labels"]}, "outputs", "carry labels"),
        ({"phase": [0.5]}, "phase", "modes of motion"),
    ):
        answer = http.post("/v1/scenes/poor/render", json=body(asked, dtype=None))
        assert (answer.status_code, answer.json()["field"]) == (422, field), answer.text
        assert words in answer.json()["detail"]
    specification = {"scene": "poor", "poses": [POSE.tolist()], "contact": "air"}
    refused = http.post("/v1/jobs", json={"kind": "render", "specification": specification}).json()
    assert refused["field"] == "specification.contact"


def test_labels_are_numbers_in_every_form(http, scene):
    truth = expected(scene, "labels")[0].astype(np.uint8)
    asked = {key: value for key, value in body(CASES["labels"][0], outputs=["labels"]).items() if key != "dtype"}
    raw = http.post("/v1/scenes/rich/render", json=asked, headers=RAW)
    np.testing.assert_array_equal(np.frombuffer(raw.content, np.uint8).reshape(truth.shape), truth)
    picture = http.post("/v1/scenes/rich/render", json=asked, headers={"Accept": "image/jpeg, image/*;q=0.5"})
    assert picture.headers["Content-Type"] == "image/png"  # jpeg would change them
    assert http.post("/v1/scenes/rich/render", json=asked, headers={"Accept": "image/jpeg"}).status_code == 406


def test_a_scene_tells_what_it_has(http, service):
    rich, poor = http.get("/v1/scenes/rich").json(), http.get("/v1/scenes/poor").json()
    assert (rich["beam"], poor["beam"]) == (to_dict(BEAM), None)
    assert (rich["speckle"], poor["speckle"]) == (True, False)
    assert (rich["label_names"], poor["label_names"]) == ({"1": "bone", "200": "vessel"}, {})
    with service.channel() as channel:
        stub = scenes_pb2_grpc.SceneServiceStub(channel)
        message = stub.GetScene(scenes_pb2.GetSceneRequest(scene="rich"), timeout=300)
    assert (dict(message.label_names), message.beam.thickness_mm) == (NAMES, 3.0)


def test_a_frame_of_a_scene_that_breathes_is_rendered_again_from_the_phase_that_it_tells(http, scene):
    asked = {"breathing": {"period_s": 3.0, "depth": 0.5}}
    answer = http.post("/v1/scenes/rich/render", json=body(asked), headers=RAW)
    assert answer.status_code == 200, answer.text
    (number,) = json.loads(answer.headers["X-Ultragray-Phase"])
    assert 0.0 <= number <= 0.5
    again = http.post("/v1/scenes/rich/render", json=body({"phase": [number]}), headers=RAW)
    assert again.content == answer.content
    truth = render(scene.at_phase((number,)), None, POSE, height=HEIGHT, width=WIDTH, beam=BEAM).bmode[0]
    np.testing.assert_allclose(np.frombuffer(answer.content, "<f4").reshape(truth.shape), truth, atol=1e-5)
    mode = http.get("/v1/scenes/rich").json()["motion"]["modes"][0]
    assert (mode["name"], mode["low"], mode["high"]) == ("breathing", 0.0, 1.0)

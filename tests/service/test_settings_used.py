"""Every door tells every setting of a frame as it was used: none of them has a list of its own."""

import json
import pickle
from dataclasses import fields, replace
from enum import Enum
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.contract import to_dict
from ultragray.exchange.exports.exporter import ExportHeader
from ultragray.exchange.exports.plus_sequence import PlusExporter
from ultragray.exchange.ros_messages import geometry_document
from ultragray.geometry.probe import ElevationBeam
from ultragray.rendering.display import Display
from ultragray.rendering.settings import Additions, Resolved, SettingsUsed, settings_used
from ultragray.rendering.tools import Needle
from ultragray.scene.confidence import Extrapolation
from ultragray_client.frames import frame_from_message, origin_of, received_frame
from ultragray_proto.v1 import rendering_pb2
from ultragray_service.core.open_streams import StreamAnswer
from ultragray_service.http.routes.rendering import render_headers
from ultragray_service.http.routes.streams import frame_bytes
from ultragray_service.igtl.frames import Frame, PoseMessage, image_of
from ultragray_service.igtl.messages import Message
from ultragray_service.rpc.messages import serialized_frame
from ultragray_workers.pool.messages import RenderResult

HEIGHT, WIDTH = 12, 10
EXAMPLES = {float: 0.25, int: 3, bool: True, str: "arm", Needle: Needle(tip_mm=(0.0, 0.0, 9.0), hub_mm=(5.0, 0.0, 1.0))}


def example(annotation, default):
    """A value of an annotation that is not the default."""
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return next(one for one in annotation if one is not default)
    if annotation in EXAMPLES:
        return EXAMPLES[annotation]
    if "members" in vars(annotation) if isinstance(annotation, type) else False:
        return next(value for value in EXAMPLES.values() if isinstance(value, annotation))
    inner = example(get_args(annotation)[0], default)
    return (inner,) if isinstance(default, tuple) else inner


HINTS = get_type_hints(Additions)
SETTINGS = Resolved(
    LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=24.0),
    HEIGHT,
    WIDTH,
    beam=ElevationBeam(1.5),
    display=Display(flip=True, depth_mm=18.0, gain_db_between=(-3.0, 3.0), display_seed=5),
    **{one.name: example(HINTS[one.name], one.default) for one in fields(Additions)},
)
PLAIN = Resolved(LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=24.0), HEIGHT, WIDTH)


def result(settings):
    height, width = settings.picture.height, settings.picture.width
    return RenderResult(
        scene="demo",
        scene_sha256="0" * 64,
        renderer="ultragray/0 cpu",
        settings=settings,
        poses=np.eye(4)[None],
        data=bytes(height * width),
        queue_ms=1.0,
        render_ms=2.0,
        encode_ms=0.0,
        extrapolations=(Extrapolation(1.0, 2.0, 0.5, 0.9),),
        batch_size=1,
    )


def parsed(texts, key):
    """The settings that texts tell under the keys of their names."""
    found = {}
    for one in fields(SettingsUsed):
        if (text := texts.get(key(one.name))) is not None:
            found[one.name] = text.split(",") if one.name == "outputs" else text
            if text[0] in "[{0123456789":
                found[one.name] = json.loads(text)
    return found


def http(settings):
    return parsed(render_headers(result(settings)), lambda name: f"X-Ultragray-{name.replace('_', '-').title()}")


def websocket(settings):
    message = frame_bytes(StreamAnswer(1, None, result(settings)))
    return json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")])


def grpc(settings):
    return origin_of(frame_from_message(received_frame(serialized_frame(result(settings), 1))))


def igtl(settings):
    rendered = result(settings)
    posed = PoseMessage(Message("TRANSFORM", "demo", b""), np.eye(4), 0.0)
    frame = Frame(posed, rendered, image_of(rendered), None, None)
    return parsed(frame.message("IMAGE", 2).metadata, lambda name: name)


def header(settings):
    return ExportHeader(settings, "uint8", np.eye(4)[None], "demo", "0" * 64, "ultragray/0 cpu")


def export(settings):
    return header(settings).origin()


def plus(settings):
    exporter = PlusExporter(Path("/dev/null"), header(settings))
    try:
        return parsed(exporter._fields(), lambda name: f"UltraGRay{name.title().replace('_', '')}")
    finally:
        exporter.abandon()


def ros(settings):
    """The geometry of a topic, of a recording and of a file of a job."""
    document = geometry_document(grpc(settings), "probe")
    own = geometry_document(export(settings), "probe")
    assert json.loads(json.dumps(document)) == json.loads(json.dumps(own))
    return {**document, "picture": export(settings)["picture"]}  # which has names of its own there


DOORS = [http, websocket, grpc, igtl, export, plus, ros]


@pytest.mark.parametrize("door", DOORS, ids=lambda door: door.__name__)
def test_every_door_tells_every_setting_as_used(door):
    expected = json.loads(json.dumps(to_dict(settings_used(SETTINGS))))
    told = json.loads(json.dumps(door(SETTINGS)))
    assert {name: told.get(name) for name in expected} == expected


@pytest.mark.parametrize("door", DOORS, ids=lambda door: door.__name__)
def test_what_was_not_asked_for_may_be_left_out(door):
    expected = json.loads(json.dumps(to_dict(settings_used(PLAIN))))
    told = json.loads(json.dumps(door(PLAIN)))
    left_out = expected.keys() - told.keys()
    assert left_out <= {one.name for one in fields(Additions)}
    assert {name: told[name] for name in expected.keys() - left_out} == {
        name: expected[name] for name in expected.keys() - left_out
    }


@pytest.mark.parametrize("size", [0, 1, 127, 128, 16_383, 16_384, 3 * 2**20])
def test_grpc_carries_pixels_of_any_number(size):
    pixels = bytes(range(256)) * (size // 256) + bytes(range(size % 256))
    sent = serialized_frame(replace(result(PLAIN), data=pixels), 5, dropped=2)
    frame = rendering_pb2.Frame.FromString(sent)
    assert (frame.data, frame.sequence, frame.dropped) == (pixels, 5, 2)


def test_settings_cross_to_another_process_whole():
    assert pickle.loads(pickle.dumps(SETTINGS)) == SETTINGS


def test_every_setting_has_a_value_of_its_own_here():
    assert all(getattr(SETTINGS, one.name) != one.default for one in fields(Additions))
    assert settings_used(SETTINGS).display != settings_used(PLAIN).display

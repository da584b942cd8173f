"""Scanner settings over OpenIGTLink: as PLUS has them, in a STRING and in a COMMAND, through pyigtl and as bytes."""

import json
import struct
from xml.etree import ElementTree

import numpy as np
import pyigtl
import pytest
from fastcrc import crc64

from ultragray.contract import from_dict
from ultragray.geometry.probe import Probe
from ultragray_proto.v1 import rendering_pb2, rendering_pb2_grpc
from ultragray_service.igtl.commands import (
    MAX_COMMAND_BYTES,
    MAX_PARAMETERS,
    PARAMETERS,
    Command,
    pack_command,
    pack_string,
    unpack_command,
)
from ultragray_service.igtl.contents import unpack_image, unpack_status
from ultragray_service.igtl.messages import TICKS_PER_S

from ...documents.tables import code, rows
from ..conftest import DEMO_PROBE
from ..rpc.test_grpc_render import matrix_pose
from .conftest import address_of, moved, pyigtl_client
from .test_igtl_mischief import still_serves
from .test_igtl_server import over_grpc

SET_DEPTH = '<Command Name="SetUsParameter" UsDeviceId="US"><Parameter Name="DepthMm" Value="20"/></Command>'


def command(name, *parameters):
    """The XML of a command; each parameter is a name, or a name and a value."""
    root = ElementTree.Element("Command", Name=name)
    for parameter in parameters:
        ElementTree.SubElement(root, "Parameter", dict(zip(("Name", "Value"), parameter, strict=False)))
    return ElementTree.tostring(root, encoding="unicode")


def ask(peer, text):
    """The reply to a command in a COMMAND of version 2."""
    answer = peer.ask("COMMAND", "US", pack_command(Command(3, "", text)), version=2, message_id=8)
    assert (answer.type_name, answer.device_name, answer.message_id) == ("RTS_COMMAND", "US", 8)
    reply = unpack_command(answer.content)
    root = ElementTree.fromstring(reply.text)
    assert (reply.number, answer.metadata["Status"]) == (3, root.get("Status"))
    return root


def set_to(peer, **values):
    assert ask(peer, command("SetUsParameter", *values.items())).get("Status") == "SUCCESS"


def value_of(peer, parameter):
    return ask(peer, command("GetUsParameter", (parameter,)))[0].get("Value")


# pyigtl


def test_pyigtl_sets_the_depth_by_a_string_and_gets_shorter_images(igtl_service):
    with pyigtl_client(address_of(igtl_service)) as client:
        client.send_message(pyigtl.TransformMessage(np.eye(4), device_name="demo"))
        whole = client.wait_for_message("Image_demo", timeout=300).image[0]
        client.send_message(pyigtl.StringMessage(SET_DEPTH, device_name="CMD_17"))
        reply = ElementTree.fromstring(client.wait_for_message("ACK_17", timeout=300).string)
        assert (reply.tag, reply.get("Status"), reply[0].attrib) == (
            "CommandReply",
            "SUCCESS",
            {"Name": "DepthMm", "Success": "true"},
        )
        client.send_message(pyigtl.TransformMessage(np.eye(4), device_name="demo"))
        cut = client.wait_for_message("Image_demo", timeout=300).image[0]
    assert len(cut) == round(len(whole) * 20 / (DEMO_PROBE.far_mm - DEMO_PROBE.near_mm))
    assert np.array_equal(cut, whole[: len(cut)])


# Settings


def test_gain_range_and_compensation_are_those_of_the_display_settings(peer, igtl_service):
    set_to(peer, GainPercent="40", DynRangeDb="50", TimeGainCompensation="-3 0 6")
    peer.send_pose(moved(1), version=2)
    answer = peer.receive()
    assert json.loads(answer.metadata["display"])["gain_db"] == -6.0
    display = rendering_pb2.Display(gain_db=-6.0, dynamic_range_db=50.0, tgc_db=[-3.0, 0.0, 6.0])
    settings = rendering_pb2.RenderSettings(scene="demo", display=display)
    with igtl_service.channel() as channel:
        request = rendering_pb2.RenderRequest(settings=settings, pose=matrix_pose(moved(1)))
        frame = rendering_pb2_grpc.RenderServiceStub(channel).Render(request, timeout=300)
    pixels = unpack_image(answer.content).pixels
    assert np.array_equal(pixels, np.frombuffer(frame.data, np.uint8).reshape(frame.height, frame.width))
    assert not np.array_equal(pixels, over_grpc(igtl_service, "demo", moved(1)))


def test_frames_are_those_of_where_a_device_will_be_by_its_time_stamps(peer):
    set_to(peer, PredictMs="50")
    for k in range(40):  # 30 mm/s
        peer.send_pose(moved(0.3 * k), version=2, timestamp=(k + 1) * TICKS_PER_S // 100)
        foretold = peer.receive()
    assert foretold.metadata["ahead_ms"] == "50.000"
    assert float(foretold.metadata["error_mm"]) < 1.5
    set_to(peer, PredictMs="")
    peer.send_pose(moved(0.3 * k), version=2)
    as_sent = peer.receive()
    assert "ahead_ms" not in as_sent.metadata
    there, here = (unpack_image(answer.content).matrix[0, 3] for answer in (foretold, as_sent))
    assert there - here == pytest.approx(1.5, abs=0.2)
    reply = ask(peer, command("SetUsParameter", ("PredictMs", "1001")))
    assert reply.get("Error") == "PredictMs: must be a number from 0 to 1000, got '1001'"


def test_every_parameter_is_told_as_it_was_set(peer):
    values = {
        "DepthMm": "31.5",
        "GainPercent": "62.5",
        "DynRangeDb": "55",
        "TimeGainCompensation": "-1 0 2.5 4",
        "Scene": "second",
        "Probe": '{"kind": "linear", "width_mm": 30.0, "near_mm": 0.0, "far_mm": 40.0}',
        "Phase": "0.5 -1",
        "Breathing": '{"period_s": 3.0, "depth": 0.5}',
        "Contact": "pressure",
        "IndentationMm": "2.5",
        "Registration": "",
        "PredictMs": "80",
        "Tools": "[]",
    }
    assert tuple(values) == PARAMETERS
    set_to(peer, **values)
    assert {name: value_of(peer, name) for name in values} == values
    set_to(peer, Probe="L12-4")
    assert from_dict(Probe, json.loads(value_of(peer, "Probe"))) == Probe.named["L12-4"]
    unset = dict.fromkeys(("Probe", "Phase", "Breathing", "IndentationMm", "Contact"), "")
    set_to(peer, **unset)
    assert {name: value_of(peer, name) for name in unset} == unset


def test_tissue_breathes_and_is_pressed(peer):
    def metadata():
        peer.send_pose(np.eye(4), "breathing", version=2)
        return peer.receive().metadata

    set_to(peer, Phase="0.5")
    assert metadata()["phase"] == "[0.5]"
    set_to(peer, Breathing="{}")
    peer.send_pose(np.eye(4), "breathing")
    assert "phase and breathing are given" in peer.status().text
    set_to(peer, Phase="")
    assert metadata()["phase"] != metadata()["phase"]
    set_to(peer, Breathing="", Contact="pressure", IndentationMm="2.5")
    pressed = metadata()
    assert (pressed["contact"], pressed["indentation_mm"]) == ("pressure", "2.500")
    assert float(pressed["force_n"]) > 0.0
    assert "phase" not in pressed


def test_settings_are_those_of_one_connection(connect):
    one, other = connect(), connect()
    set_to(one, DepthMm="10", GainPercent="90")
    assert (value_of(other, "GainPercent"), value_of(other, "DepthMm")) == ("50", None)
    other.send_pose(np.eye(4))
    whole = other.image().pixels
    one.send_pose(np.eye(4))
    assert len(one.image().pixels) < len(whole)


# What cannot be


@pytest.mark.parametrize(
    ("parameter", "value", "text"),
    [
        ("DepthMm", "deep", "must be a number, got 'deep'"),
        ("GainPercent", "101", "from 0 to 100, got '101'"),
        ("Probe", '{"kind": "linear", "width_mm": -1}', "near_mm is required"),
        ("Phase", "0.5,1", "must be a number, got '0.5,1'"),
        ("Breathing", "deep", """must be JSON such as {"period_s": 4.0, "depth": 1.0}, got 'deep'"""),
        ("Breathing", '{"period_s": 0}', "period_s must be a finite number from 0.2 to 60, got 0"),
        ("Contact", "firm", "contact must be one of air, pressure, got 'firm'"),
        ("IndentationMm", "2", "indentation_mm needs contact pressure"),
        ("FrequencyMhz", "5", f"must be one of {', '.join(PARAMETERS)}, got 'FrequencyMhz'"),
    ],
)
def test_a_value_that_cannot_be_is_refused_and_the_others_are_set(peer, parameter, value, text):
    valid = ("DepthMm" if parameter == "GainPercent" else "GainPercent", "25")
    reply = ask(peer, command("SetUsParameter", (parameter, value), valid))
    assert [one.get("Success") for one in reply] == ["false", "true"]
    assert reply.get("Status") == "FAIL"
    assert text in str(reply.get("Error"))
    still_serves(peer)


BOMB = '<!DOCTYPE a [<!ENTITY b "xxxxxxxxxx"><!ENTITY c "&b;&b;&b;&b;">]><Command Name="&c;"/>'


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "must be XML"),
        (BOMB, "no DOCTYPE"),
        (command("StartRecording", ("DepthMm",)), "must be SetUsParameter or GetUsParameter, got 'StartRecording'"),
        (command("SetUsParameter", ("DepthMm",)), "DepthMm: a Value is required"),
        (command("GetUsParameter", ("GainPercent",), ("GainPercent",)), "'GainPercent' twice"),
        (command("GetUsParameter", *[("P",)] * (MAX_PARAMETERS + 1)), "at most 32 parameters"),
        (f"<Command>{' ' * MAX_COMMAND_BYTES}</Command>", "at most 4096 bytes"),
    ],
)
def test_a_bad_command_gets_one_clear_reply(peer, text, expected):
    reply = ask(peer, text)
    assert reply.get("Status") == "FAIL"
    assert expected in str(reply.get("Error"))
    assert reply.get("Message") == reply.get("Error")
    still_serves(peer)


@pytest.mark.parametrize(
    ("type_name", "device_name", "content", "text"),
    [
        ("STRING", "note", pack_string("hello"), "of a device called CMD_1 or the like, got 'note'"),
        ("STRING", "CMD_1", b"\0\3\0\5hell", "a text of 5 bytes must follow, got 4"),
        ("STRING", "CMD_1", b"\0\3\0\1\xff", "ASCII or UTF-8"),
        ("COMMAND", "US", bytes(137), "138 bytes or more, got 137"),
        ("COMMAND", "US", bytes(134) + struct.pack(">I", 2**31), f"a text of {2**31} bytes must follow, got 0"),
    ],
)
def test_messages_without_a_command_are_refused(peer, type_name, device_name, content, text):
    answer = peer.ask(type_name, device_name, content)
    assert (answer.type_name, answer.device_name) == ("STATUS", device_name)
    assert text in unpack_status(answer.content).text
    still_serves(peer)


# Bytes


def framed(version, type_name, device_name, body):
    return struct.pack(">H12s20sQQQ", version, type_name, device_name, 0, len(body), crc64.ecma_182(body)) + body


def command_bytes(number, name, text):
    return number.to_bytes(4, "big") + name.ljust(128, b"\0") + b"\0\3" + len(text).to_bytes(4, "big") + text


def test_a_command_of_header_version_1_is_answered_without_metadata(peer):
    content = command_bytes(5, b"SetUsParameter", SET_DEPTH.encode())
    peer.socket.sendall(framed(1, b"COMMAND", b"US", content))
    answer = peer.receive()
    assert (answer.version, answer.type_name, answer.metadata) == (1, "RTS_COMMAND", {})
    reply = unpack_command(answer.content)
    assert (reply.number, reply.name) == (5, "SetUsParameter")
    assert answer.content == command_bytes(5, b"SetUsParameter", reply.text.encode())[:132] + answer.content[132:]


def test_a_longer_extended_header_and_metadata_around_a_command_are_skipped(peer):
    content = command_bytes(6, b"", command("GetUsParameter", ("DynRangeDb",)).encode())
    index, values = struct.pack(">HHHI", 1, 4, 3, 2), b"Keyavl"
    extended = struct.pack(">HHIIxxxx", 16, len(index), len(values), 99)  # a later version may add fields
    peer.socket.sendall(framed(2, b"COMMAND", b"US", extended + content + index + values))
    answer = peer.receive()
    assert (answer.message_id, answer.metadata) == (99, {"DynRangeDb": "60", "Status": "SUCCESS"})
    assert unpack_command(answer.content).name == "GetUsParameter"


def test_a_name_in_the_header_must_be_that_of_the_xml(peer):
    answer = peer.ask("COMMAND", "US", pack_command(Command(1, "GetUsParameter", SET_DEPTH)))
    assert "calls the command 'GetUsParameter', its XML 'SetUsParameter'" in unpack_command(
        answer.content
    ).text.replace("&#39;", "'")


def test_parameters_are_those_of_the_reference():
    assert tuple(code(cells[0])[0] for cells in rows("openigtlink.md", "Scanner settings")) == PARAMETERS

"""RenderService against a real service: framing, errors and streams. What messages hold is the codec's to test."""

import queue

import grpc
import numpy as np
import pytest
from google.rpc.error_details_pb2 import BadRequest, ErrorInfo
from google.rpc.status_pb2 import Status

from ultragray_proto.v1 import geometry_pb2, rendering_pb2

from ..conftest import HEIGHT

TIMEOUT_S = 300


def error_info(error):
    """What grpc-status-details-bin says, after checking that it agrees with the status itself."""
    trailers = dict(error.trailing_metadata())
    status = Status.FromString(trailers["grpc-status-details-bin"])
    assert status.code == error.code().value[0]
    assert status.message == error.details()
    assert trailers["x-request-id"]
    info, violation = ErrorInfo(), None
    assert status.details[0].Unpack(info)
    for detail in status.details[1:]:
        if detail.Is(BadRequest.DESCRIPTOR):
            violation = BadRequest()
            detail.Unpack(violation)
    assert info.domain == "ultragray"
    return info, violation


def moved(x_mm):
    position = geometry_pb2.Position(x=x_mm)
    return geometry_pb2.Pose(
        placement=geometry_pb2.Placement(position_mm=position, quaternion=geometry_pb2.Quaternion(w=1.0))
    )


def matrix_pose(matrix):
    return geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=np.asarray(matrix).ravel().tolist()))


class Conversation:
    """A stream whose messages are sent one by one."""

    def __init__(self, stub):
        self._outgoing = queue.Queue()
        self.call = stub.RenderStream(iter(self._outgoing.get, None), timeout=TIMEOUT_S)

    def send(self, sequence=0, **fields):
        self._outgoing.put(rendering_pb2.RenderStreamRequest(sequence=sequence, **fields))

    def ask(self, sequence, **fields):
        self.send(sequence, **fields)
        frame = next(self.call)
        assert frame.sequence == sequence
        return frame

    def finish(self):
        self._outgoing.put(None)
        return list(self.call)


@pytest.fixture
def conversation(renders):
    conversation = Conversation(renders)
    yield conversation
    conversation.finish()


def test_a_stream_is_a_dialogue_whose_settings_may_change(conversation, settings_message):
    first = conversation.ask(1, settings=settings_message, pose=moved(0))
    small = rendering_pb2.RenderSettings(scene="second", height=10, width=12)
    second = conversation.ask(2, settings=small, pose=moved(0))
    third = conversation.ask(3, pose=moved(0))
    assert (first.scene, first.height) == ("demo", HEIGHT)
    for frame in (second, third):
        assert (frame.scene, frame.height, frame.width) == ("second", 10, 12)


def test_an_unknown_mode_ends_the_stream(renders, settings_message):
    conversation = Conversation(renders)
    conversation.send(settings=settings_message, mode=9)
    with pytest.raises(grpc.RpcError, match="StreamMode"):
        next(conversation.call)


def test_bad_messages_do_not_end_a_stream(conversation, settings_message):
    def ask(sequence, **fields):
        frame = conversation.ask(sequence, **fields)
        assert not frame.data
        assert frame.error.detail
        return frame.error.reason, frame.error.field

    def settings(**fields):
        return rendering_pb2.RenderSettings(**{"scene": "demo", **fields})

    assert ask(1, pose=moved(0)) == ("INVALID_ARGUMENT", "settings")
    assert conversation.ask(2, settings=settings_message, pose=moved(0)).data
    assert ask(3, pose=matrix_pose(np.diag([-1, 1, 1, 1]))) == ("INVALID_POSE", "pose.matrix")
    assert ask(4) == ("INVALID_ARGUMENT", "pose")
    assert ask(5, settings=settings(scene="nowhere"), pose=moved(0)) == ("SCENE_NOT_FOUND", "settings.scene")
    assert ask(6, settings=settings(scene="truncated")) == ("SCENE_FILE_INVALID", "settings.scene")
    assert ask(7, settings=settings(outputs=[9])) == ("UNKNOWN_OUTPUT", "settings.outputs")
    frame = conversation.ask(8, pose=moved(0))
    assert frame.data
    assert frame.scene == "demo"


def test_bytes_that_are_no_message_do_not_end_a_stream(channel, settings_message):
    whole = rendering_pb2.RenderStreamRequest(
        sequence=7, settings=settings_message, pose=moved(1.0)
    ).SerializeToString()
    call = channel.stream_stream("/ultragray.v1.RenderService/RenderStream")(
        iter([b"\x0a\x05ab", *[whole, b"\x0a\x05ab"] * 20]), timeout=TIMEOUT_S
    )
    frames = [rendering_pb2.Frame.FromString(answer) for answer in call]
    assert [frame.error.reason for frame in frames] == ["INVALID_ARGUMENT", *["", "INVALID_ARGUMENT"] * 20]
    assert {frame.sequence for frame in frames if frame.data} == {7}


def bad(**fields):
    def make():
        pose = fields.get("pose", moved(0))
        settings = {"scene": "demo", **{key: value for key, value in fields.items() if key != "pose"}}
        return rendering_pb2.RenderRequest(settings=rendering_pb2.RenderSettings(**settings), pose=pose)

    return make


def quaternion(w):
    return geometry_pb2.Pose(
        placement=geometry_pb2.Placement(position_mm=geometry_pb2.Position(), quaternion=geometry_pb2.Quaternion(w=w))
    )


INVALID = grpc.StatusCode.INVALID_ARGUMENT

BAD_REQUESTS = {
    "norm": (bad(pose=quaternion(3.0)), INVALID, "INVALID_POSE", "pose.placement.quaternion"),
    "no pose": (bad(pose=None), INVALID, "INVALID_ARGUMENT", "pose"),
    "scene": (bad(scene="nowhere"), grpc.StatusCode.NOT_FOUND, "SCENE_NOT_FOUND", "settings.scene"),
}


@pytest.mark.parametrize("case", BAD_REQUESTS)
def test_bad_request(renders, settings_message, case):
    make, code, reason, field = BAD_REQUESTS[case]
    with pytest.raises(grpc.RpcError) as caught:
        renders.Render(make(), timeout=TIMEOUT_S)
    info, violation = error_info(caught.value)
    assert (caught.value.code(), info.reason, info.metadata["field"]) == (code, reason, field)
    if code is INVALID:
        assert violation.field_violations[0].field == field
    request = rendering_pb2.RenderRequest(settings=settings_message, pose=moved(0))
    assert renders.Render(request, timeout=TIMEOUT_S).data


@pytest.mark.parametrize(("count", "reason"), [(0, "INVALID_ARGUMENT"), (41, "TOO_MANY_POSES")])
def test_batches_of_no_or_too_many_poses(renders, settings_message, count, reason):
    request = rendering_pb2.RenderBatchRequest(settings=settings_message, poses=[moved(0)] * count)
    with pytest.raises(grpc.RpcError) as caught:
        list(renders.RenderBatch(request, timeout=TIMEOUT_S))
    info, _ = error_info(caught.value)
    assert (info.reason, info.metadata["field"]) == (reason, "poses")


def test_one_bad_pose_refuses_a_batch_before_its_first_frame(renders, settings_message):
    poses = [moved(0), moved(0), quaternion(0.5)]
    request = rendering_pb2.RenderBatchRequest(settings=settings_message, poses=poses)
    with pytest.raises(grpc.RpcError) as caught:
        next(renders.RenderBatch(request, timeout=TIMEOUT_S))
    assert error_info(caught.value)[0].metadata["field"] == "poses[2].placement.quaternion"

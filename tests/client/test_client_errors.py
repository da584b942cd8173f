"""Every error of the service arrives as one of the client's; what is asked again, for how long, and what is not."""

import socket
from concurrent import futures

import grpc
import numpy as np
import pytest
from google.protobuf.any_pb2 import Any as AnyMessage
from google.rpc.status_pb2 import Status

from ultragray import errors as library_errors
from ultragray.errors import error_classes
from ultragray_client import RenderSettings, connection, conversations, errors
from ultragray_client.connection import Retries, error_of_call, error_of_frame
from ultragray_client.conversations import Batch
from ultragray_client.frames import settings_message
from ultragray_proto.v1 import rendering_pb2, scenes_pb2
from ultragray_service import errors as service_errors
from ultragray_service.errors import STATUSES
from ultragray_service.rpc.calls import status_of
from ultragray_workers import errors as workers_errors

MODULES = (library_errors, workers_errors, service_errors)
ALL = [cls for cls in error_classes() if cls.__module__ in {module.__name__ for module in MODULES}]
KNOWN = {error.reason for error in errors.ERRORS}


class FailedCall(grpc.RpcError):
    """As grpc raises it."""

    def __init__(self, code, details, status=None):
        super().__init__()
        self._code, self._details, self._status = code, details, status

    def code(self):
        return self._code

    def details(self):
        return self._details

    def trailing_metadata(self):
        return () if self._status is None else (("grpc-status-details-bin", self._status), ("x-request-id", "1"))


@pytest.mark.parametrize("cls", ALL, ids=lambda cls: cls.reason)
def test_every_error_keeps_its_facts(cls):
    statuses = STATUSES[cls.reason]
    told = status_of(cls("what is wrong", field="settings.scene"))
    error = error_of_call(
        FailedCall(getattr(grpc.StatusCode, statuses.grpc), told.message, told.SerializeToString()), "x"
    )
    assert (error.reason, error.detail, error.field) == (cls.reason, "what is wrong", "settings.scene")
    assert error.retry_after_s == statuses.retry_after_s
    if statuses.grpc in {known.grpc_status for known in errors.ERRORS}:
        assert error.grpc_status == statuses.grpc
    if cls.reason in KNOWN:
        assert type(error).reason == cls.reason


def test_statuses_without_details():
    assert isinstance(error_of_call(FailedCall(grpc.StatusCode.UNAVAILABLE, "refused"), "there"), errors.Unreachable)
    assert isinstance(error_of_call(FailedCall(grpc.StatusCode.DEADLINE_EXCEEDED, "late"), "there"), TimeoutError)
    too_large = error_of_call(FailedCall(grpc.StatusCode.RESOURCE_EXHAUSTED, "message larger than max"), "there")
    assert (type(too_large), too_large.retry_after_s) == (errors.ResourceExhausted, None)
    assert error_of_call(FailedCall(grpc.StatusCode.UNKNOWN, "?"), "there").reason == "UNKNOWN"
    broken = "Stream removed (RST_STREAM (Received RST_STREAM with error code 2))"  # as Envoy, whose service was killed
    assert isinstance(error_of_call(FailedCall(grpc.StatusCode.INTERNAL, broken), "there"), errors.Unreachable)


def test_details_of_others_are_passed_over():
    status = Status(code=5, message="no")
    other = AnyMessage(type_url="type.googleapis.com/google.rpc.DebugInfo", value=b"\x12\x02no")
    status.details.append(other)
    error = error_of_call(FailedCall(grpc.StatusCode.NOT_FOUND, "no", status.SerializeToString()), "there")
    assert (type(error), error.reason) == (errors.NotFound, "NOT_FOUND")


def test_errors_in_place_of_frames():
    error = error_of_frame(scenes_pb2.Error(reason="INVALID_POSE", field="pose", detail="no"), 7)
    assert (type(error), error.field, error.sequence) == (errors.InvalidPose, "pose", 7)
    assert error_of_frame(scenes_pb2.Error(reason="NEW", detail="no"), 1).reason == "NEW"


def test_a_refused_pose_of_a_batch_is_named_by_its_place_in_the_whole(monkeypatch):
    """Also one that is told as a single pose: frames come in their order."""
    monkeypatch.setattr(conversations, "frame_from_message", lambda *_, **__: None)
    for field, place in (("poses[2].matrix", 258), ("pose", 257)):
        batch = Batch(settings_message("demo", RenderSettings()), np.tile(np.eye(4), (300, 1, 1)))
        for number in range(257):
            if number % 256 == 0:
                assert batch.request() is not None
            batch.take(rendering_pb2.Frame())
        with pytest.raises(errors.InvalidPose) as caught:
            batch.pause_s(errors.InvalidPose(f"{field} is no pose", field=field), Retries(60.0, None))
        assert caught.value.field == field.replace(field.partition(".")[0], f"poses[{place}]")
        assert caught.value.detail == f"{caught.value.field} is no pose"


def test_pauses_grow_after_the_delay_that_the_service_told():
    retries = Retries(1000.0, patience_s=None)
    full = errors.QueueFull("full", retry_after_s=2.0)
    pauses_s = [retries.pause_s(full) for _ in range(10)]
    for failures, pause_s in enumerate(pauses_s):
        backoff_s = min(0.1 * 2**failures, 5.0)
        assert 2.0 + 0.5 * backoff_s <= pause_s <= 2.0 + backoff_s
    retries.progress()
    assert retries.pause_s(full) <= 2.1
    assert len({Retries(1000.0, None).pause_s(full) for _ in range(5)}) > 1


@pytest.mark.parametrize(
    "error",
    [
        errors.InvalidPose("no"),
        errors.SceneNotFound("no"),
        errors.StorageFull("no"),
        errors.DeadlineExceeded("no"),
        errors.RenderFailed("no"),
        errors.Unauthenticated("no"),
    ],
)
def test_what_cannot_succeed_is_not_asked_again(error):
    with pytest.raises(type(error)):
        Retries(1000.0, 1000.0).pause_s(error)


def test_no_pause_reaches_beyond_the_deadline():
    retries = Retries(5.0, patience_s=1000.0)
    assert retries.pause_s(errors.QueueFull("full", retry_after_s=1.0)) < 5.0
    with pytest.raises(errors.JobQueueFull):
        retries.pause_s(errors.JobQueueFull("full", retry_after_s=10.0))
    remaining_s = retries.remaining_s()
    assert 4.0 < remaining_s <= 5.0


def test_without_a_deadline_patience_counts_from_the_first_failure_since_anything_came(monkeypatch):
    now = 1000.0
    monkeypatch.setattr(connection.time, "monotonic", lambda: now)
    retries = Retries(None, patience_s=3.0)
    assert retries.remaining_s() is None
    gone = errors.Unreachable("gone")
    now += 4.0  # a quiet call is no failure
    assert retries.pause_s(gone) < 3.0
    now += 2.9
    with pytest.raises(errors.Unreachable):
        retries.pause_s(gone)
    retries.progress()
    assert retries.pause_s(gone) < 3.0


def test_the_shorter_of_deadline_and_patience_counts():
    gone = errors.Unreachable("gone", retry_after_s=2.0)
    for retries in (Retries(1.0, patience_s=60.0), Retries(60.0, patience_s=1.0)):
        with pytest.raises(errors.Unreachable):
            retries.pause_s(gone)
    with pytest.raises(errors.Unreachable):
        Retries(60.0, patience_s=0.0).pause_s(errors.Unreachable("gone"))


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def test_nobody_there_is_told_in_time(make_client):
    client = make_client(f"127.0.0.1:{free_port()}")
    with pytest.raises(errors.Unreachable, match="no service answers at 127"):
        client.scenes.list(timeout_s=1.0)


class _Deadlines(grpc.GenericRpcHandler):
    """Notes how long each call may take, s, and refuses it."""

    def __init__(self):
        self.found = {}

    def service(self, details):
        def refuse(_, context):
            self.found[details.method.rpartition("/")[2]] = context.time_remaining()
            context.abort(grpc.StatusCode.INVALID_ARGUMENT, "no")

        return grpc.unary_unary_rpc_method_handler(refuse)


def test_a_recording_is_finished_without_a_deadline_of_the_clients_own(make_client):
    deadlines = _Deadlines()
    server = grpc.server(futures.ThreadPoolExecutor(2), handlers=[deadlines])
    client = make_client(f"127.0.0.1:{server.add_insecure_port('127.0.0.1:0')}", timeout_s=30.0)
    server.start()
    calls = {
        "GetRecording": lambda: client.recordings.get("liver"),
        "FinishRecording": lambda: client.recordings.finish("liver"),
        "DeleteRecording": lambda: client.recordings.delete("liver"),
    }
    for call in calls.values():
        with pytest.raises(errors.InvalidArgument):
            call()
    own = {name for name, seconds in deadlines.found.items() if seconds is not None and seconds < 60.0}
    assert (set(deadlines.found), own) == (set(calls), {"GetRecording", "DeleteRecording"})
    with pytest.raises(errors.InvalidArgument):
        client.recordings.finish("liver", timeout_s=20.0)
    assert deadlines.found["FinishRecording"] < 60.0
    server.stop(None)

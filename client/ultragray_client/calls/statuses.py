"""From a failed gRPC call to an error of the client."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import grpc
from google.protobuf.any_pb2 import Any as AnyMessage
from google.protobuf.duration_pb2 import Duration
from google.protobuf.empty_pb2 import Empty
from google.protobuf.unknown_fields import UnknownFieldSet

from ultragray_proto.v1 import scenes_pb2

from ..errors import ERRORS, ClientError, TlsFailed, Unreachable

_DETAILS_KEY = "grpc-status-details-bin"
_TLS_FAILURES = {  # by a part of what grpc says
    "WRONG_VERSION_NUMBER": "does not speak TLS: leave out tls",
    "CERTIFICATE_VERIFY_FAILED": "shows a certificate that is out of its time, or that no trusted authority signed: "
    "give its authority as tls.root_certificates",
    "Hostname Verification Check failed": "shows a certificate of another name: reach it by a name of its certificate, "
    "or give one as tls.server_name",
}
_NO_ADDRESS = "failed to connect to all addresses"
_CUT_OFF = ("Socket closed", "Connection reset")  # all that grpc says where a server wanted TLS, or a certificate
_BROKEN = "Received RST_STREAM"  # with any status: a proxy lost the service in the middle of a call
_BY_REASON = {error.reason: error for error in ERRORS}
_BY_STATUS = {error.grpc_status: error for error in reversed(ERRORS)}  # of several, the root of the branch


@contextmanager
def client_errors(address: str) -> Iterator[None]:
    """Raises the ClientError of a gRPC call that fails in the context."""
    try:
        yield
    except grpc.RpcError as failure:
        raise error_of_call(failure, address) from None


def error_of_call(error: grpc.RpcError, address: str) -> ClientError:
    """The error of a failed call, from its ErrorInfo and RetryInfo, else from its status."""
    status, sentence = error.code().name, error.details() or ""
    reason, field, retry_after_s = _details(dict(error.trailing_metadata() or ()).get(_DETAILS_KEY, b""))
    if reason is None and (status == "UNAVAILABLE" or _BROKEN in sentence):
        return _unreachable(sentence, address)
    cls = _BY_REASON.get(reason or status) or _BY_STATUS.get(status, ClientError)
    return cls(sentence, reason=reason or status, field=field, retry_after_s=retry_after_s)


def _unreachable(sentence: str, address: str) -> ClientError:
    for part, meaning in _TLS_FAILURES.items():
        if part in sentence:
            return TlsFailed(f"{address} {meaning} ({sentence})")
    hint = ""
    if any(part in sentence for part in _CUT_OFF):
        hint = "; it may want TLS, or a client's certificate: see tls"
    if sentence.startswith(_NO_ADDRESS):  # of gRPC's words for each address that it tried the last ones say why
        sentence = sentence.rpartition(": ")[2].lower()
    return Unreachable(f"no service answers at {address} ({sentence}){hint}")


def error_of_frame(error: scenes_pb2.Error, sequence: int) -> ClientError:
    """The error that a stream has in place of a frame."""
    cls = _BY_REASON.get(error.reason, ClientError)
    return cls(error.detail, reason=error.reason, field=error.field or None, sequence=sequence)


def _details(status: bytes) -> tuple[str | None, str | None, float | None]:
    """Reason, field and delay in seconds of a google.rpc.Status, whose messages protobuf does not come with."""
    reason = field = retry_after_s = None
    for packed in _values(status, 3):
        detail = AnyMessage.FromString(packed)
        if detail.type_url.endswith("/google.rpc.ErrorInfo"):
            reason = next((value.decode() for value in _values(detail.value, 1)), None)
            metadata = {_text(entry, 1): _text(entry, 2) for entry in _values(detail.value, 3)}
            field = metadata.get("field")
        elif detail.type_url.endswith("/google.rpc.RetryInfo"):
            for delay in _values(detail.value, 1):
                retry_after_s = Duration.FromString(delay).ToTimedelta().total_seconds()
    return reason, field, retry_after_s


def _values(message: bytes, number: int) -> Iterator[Any]:
    """The values of one field of a message whose type is not known."""
    unknown = UnknownFieldSet(Empty.FromString(message))
    return (field.data for field in unknown if field.field_number == number)


def _text(message: bytes, number: int) -> str:
    return b"".join(_values(message, number)).decode()

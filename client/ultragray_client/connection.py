"""The way of a call: its channel and certificates, its metadata, its attempts, and the error that it ends with."""

from __future__ import annotations

import ipaddress
import random
import re
import ssl
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias
from urllib.parse import quote

import grpc
from google.protobuf.any_pb2 import Any as AnyMessage
from google.protobuf.duration_pb2 import Duration
from google.protobuf.empty_pb2 import Empty
from google.protobuf.unknown_fields import UnknownFieldSet

from ultragray_client.errors import (
    ERRORS,
    ClientError,
    InvalidArgument,
    ResourceExhausted,
    TlsFailed,
    Unavailable,
    Unreachable,
)
from ultragray_proto.v1 import scenes_pb2

_FIRST_PAUSE_S = 0.1
_LONGEST_PAUSE_S = 5.0


class Retries:
    """The attempts of one call of the user, which end when the first of two times has passed.

    `timeout_s` counts from now, `patience_s` from the first failure since anything came, for calls that go on for as
    long as they take. None: as long as it takes; a patience of 0: one failure ends it.
    """

    def __init__(
        self, timeout_s: float | None, patience_s: float | None, *, longest_pause_s: float = _LONGEST_PAUSE_S
    ) -> None:
        self._deadline = None if timeout_s is None else time.monotonic() + timeout_s
        self._patience_s = patience_s
        self._longest_pause_s = longest_pause_s
        self.was_unavailable = False  # at any attempt: then it is not known whether that one worked
        self.progress()

    def progress(self) -> None:
        """Something came: the next failure is a first one."""
        self._failing_since: float | None = None
        self._failures = 0

    def remaining_s(self) -> float | None:
        """The deadline of the next attempt, in seconds from now; None: it has none."""
        return None if self._deadline is None else max(self._deadline - time.monotonic(), 0.0)

    @property
    def may_go_on(self) -> bool:
        """Whether any failure may be followed by another attempt."""
        return self._patience_s != 0.0

    def may_help(self, error: ClientError) -> bool:
        """Whether another attempt may succeed after an error."""
        overloaded = isinstance(error, ResourceExhausted) and error.retry_after_s is not None
        return self.may_go_on and (overloaded or isinstance(error, Unavailable))

    def pause_s(self, error: ClientError) -> float:
        """The seconds to wait before the next attempt: exponential, with jitter, after any delay that the service told.

        Raises `error` where another attempt cannot succeed, or would come too late.
        """
        self.was_unavailable |= isinstance(error, Unavailable)
        if not self.may_help(error):
            raise error
        backoff_s = min(_FIRST_PAUSE_S * 2.0**self._failures, self._longest_pause_s)
        pause_s = (error.retry_after_s or 0.0) + backoff_s * random.uniform(0.5, 1.0)
        now = time.monotonic()
        if self._failing_since is None:
            self._failing_since = now
        ends = [self._deadline, None if self._patience_s is None else self._failing_since + self._patience_s]
        if any(end is not None and now + pause_s >= end for end in ends):
            raise error
        self._failures += 1
        return pause_s


# Options of a connection, and calls that go on where they broke off.
ApiKey: TypeAlias = str | Callable[[], str]  # of which the function gives one that is valid when it is called

DEFAULT_ADDRESS = "localhost:50051"
DEFAULT_TIMEOUT_S = 30.0
LONGEST_PAUSE_OF_STREAMS_S = 1.0  # between attempts to go on: a control loop waits
CHANNEL_OPTIONS: tuple[tuple[str, str | int], ...] = (
    ("grpc.max_receive_message_length", -1),  # a frame of float32 outputs may be larger than the usual 4 MiB
    ("grpc.keepalive_time_ms", 30_000),  # only while calls are under way; a peer that vanished is noticed
    ("grpc.keepalive_timeout_ms", 10_000),
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 2_000),
)
SCENE_KEY = "x-ultragray-scene"
Metadata: TypeAlias = tuple[tuple[str, str], ...]


def metadata_of(request: Any, api_key: ApiKey | None) -> Metadata:
    """The metadata of a call: the key, and the scene that the request names, by which a proxy sends the calls of one
    scene to the same replica.

    `request`: a message, or anything else with the same `scene` or `settings.scene`.
    """
    scene = getattr(getattr(request, "settings", request), "scene", "")
    metadata: Metadata = ((SCENE_KEY, quote(scene, safe="")),) if scene else ()
    if api_key is None:
        return metadata
    return (*metadata, ("x-api-key", api_key if isinstance(api_key, str) else api_key()))


class Terms:
    """What goes with every call of a client: address, key, and how long it may take. Raises InvalidArgument."""

    def __init__(self, address: str, api_key: ApiKey | None, tls: Tls | None, timeout_s: float) -> None:
        self.address, self.tls = target_of(address, tls)
        self._api_key, self._timeout_s = api_key, check_timeout(timeout_s)
        if api_key is not None and self.tls is None:
            warn_of_open_key(self.address)

    def metadata(self, request: Any) -> Metadata:
        """The metadata of a call; `request` as in `metadata_of`."""
        return metadata_of(request, self._api_key)

    def retries(self, timeout_s: float | None, *, is_short: bool = False) -> Retries:
        """The attempts within `timeout_s`.

        None: as the client has it for a short call; of others as long as they take, with so much patience.
        """
        if timeout_s is None and not is_short:
            return Retries(None, self._timeout_s)
        return Retries(check_timeout(self._timeout_s if timeout_s is None else timeout_s), None)

    def stream_retries(self, timeout_s: float | None, reconnect_s: float | None) -> Retries:
        """The calls of a stream of poses, one after another.

        They end after `timeout_s` (None: they may last), or when no other call has brought anything for `reconnect_s`
        after one that broke (None: the client's timeout_s).
        """
        return Retries(
            None if timeout_s is None else check_timeout(timeout_s),
            self._timeout_s if reconnect_s is None else check_reconnect(reconnect_s),
            longest_pause_s=LONGEST_PAUSE_OF_STREAMS_S,
        )


def check_timeout(timeout_s: float) -> float:
    """Raises InvalidArgument unless above 0."""
    if not timeout_s > 0.0:
        raise InvalidArgument(f"timeout_s must be above 0, got {timeout_s:g}", field="timeout_s")
    return timeout_s


def check_reconnect(reconnect_s: float) -> float:
    """Raises InvalidArgument for less than 0."""
    if not reconnect_s >= 0.0:
        raise InvalidArgument(f"reconnect_s must be at least 0, got {reconnect_s:g}", field="reconnect_s")
    return reconnect_s


# From a failed gRPC call to an error of the client.
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
    if _HTTP_1 in sentence:
        return Unreachable(f"{address} is a port of HTTP: give that of gRPC, 50051 unless the service has another")
    hint = ""
    if any(part in sentence for part in _CUT_OFF):
        hint = "; it may want TLS, or a client's certificate: see tls"
    if sentence.startswith(_NO_ADDRESS):  # of gRPC's words for each address that it tried the last ones say why
        sentence = sentence.rpartition(": ")[2].lower()
    return Unreachable(f"no service answers at {address} ({sentence}){hint}")


def error_of_frame(error: scenes_pb2.Error, sequence: int | None) -> ClientError:
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


# Encrypted channels: the certificates of both sides, and a warning where a key would travel in the open.
_URL = re.compile(r"(?:(https?)://)([^/]*)(.*)")
_TARGET = re.compile(r"(?:dns:(?://[^/]*/)?|ipv[46]:)?(\[[^]]*\]|[^:]*)")  # of gRPC: the host
_HTTP_1 = "http1.x server"  # in gRPC's words
_LOCAL_SCHEMES = ("unix:", "unix-abstract:")


@dataclass(frozen=True, kw_only=True)
class Tls:
    """A connection over TLS, by files in PEM format, which are read when the client is made.

    `Tls()` trusts the authorities that the system trusts. The hospital's own is given as `root_certificates`, and for a
    service that asks for the certificates of its clients (mutual TLS) `certificate` with its `key`, not encrypted.
    `server_name` is a name of the service's certificate, where it is reached by another one.
    """

    root_certificates: str | Path | None = None
    certificate: str | Path | None = None
    key: str | Path | None = None
    server_name: str | None = None

    def credentials(self) -> grpc.ChannelCredentials:
        """Credentials of a channel. Raises InvalidArgument for a file that cannot be used."""
        if (self.certificate is None) is not (self.key is None):
            raise InvalidArgument("tls.certificate and tls.key must be given together", field="tls")
        context = ssl.create_default_context()
        if self.root_certificates is not None:
            with _blamed("tls.root_certificates", self.root_certificates):
                context.load_verify_locations(self.root_certificates)
                roots = Path(self.root_certificates).read_bytes()
        else:  # where the system has none, grpc falls back to its own
            roots = "".join(map(ssl.DER_cert_to_PEM_cert, context.get_ca_certs(binary_form=True))).encode()
        if self.certificate is None or self.key is None:
            return grpc.ssl_channel_credentials(roots or None)
        with _blamed("tls.certificate", f"{self.certificate} with the key {self.key}"):
            context.load_cert_chain(self.certificate, self.key, password="")
            pair = Path(self.key).read_bytes(), Path(self.certificate).read_bytes()
        return grpc.ssl_channel_credentials(roots or None, *pair)

    def options(self) -> tuple[tuple[str, str | int], ...]:
        """Options of a channel."""
        if self.server_name is None:
            return CHANNEL_OPTIONS
        return (*CHANNEL_OPTIONS, ("grpc.ssl_target_name_override", self.server_name))


@contextmanager
def _blamed(field: str, what: object) -> Iterator[None]:
    try:
        yield
    except ssl.SSLError as error:
        raise InvalidArgument(f"{field}: {what} cannot be used ({error.reason or error})", field=field) from None
    except OSError as error:
        raise InvalidArgument(f"{field}: {what} cannot be read ({error.strerror})", field=field) from None


def target_of(address: str, tls: Tls | None) -> tuple[str, Tls | None]:
    """What gRPC connects to, and its certificates: of a URL the host and port, and of https those of the system.

    Raises InvalidArgument for an http URL with `tls`, for one with a path, and for an empty address.
    """
    match = _URL.fullmatch(address)
    scheme, host, path = ("", address, "") if match is None else match.groups()
    if not host or path.strip("/") or (scheme == "http" and tls is not None):
        raise InvalidArgument(
            f"address must be HOST:PORT of the service's gRPC, http:// before it without TLS or https:// with it, "
            f"got {address!r}{'' if tls is None else ' and tls'}",
            field="address",
        )
    return host, Tls() if scheme == "https" and tls is None else tls


def warn_of_open_key(address: str) -> None:
    """Warns, once for each place that makes such a client, that others on the way can read its key."""
    if not is_local(address):
        warnings.warn(
            f"the API key travels unencrypted to {address}, and whoever is on the way can read it: give tls=Tls(...)",
            UserWarning,
            stacklevel=5,  # where the client is made
        )


def is_local(address: str) -> bool:
    """Whether an address is one of this host alone."""
    if address.startswith(_LOCAL_SCHEMES):
        return True
    match = _TARGET.match(address)
    host = "" if match is None else match[1].strip("[]")
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False

"""HTTP connections with bounds: on what is read before it is parsed, on time, and on requests that pile up.

uvicorn bounds none of these by itself: a head of any length, a body that never ends and any number of pipelined
requests reach its parser. The bounds are a subclass of its protocol, and parsing stays its own.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import httptools
import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol
from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.exceptions import InvalidHandshake, InvalidState
from websockets.frames import Frame
from websockets.http11 import Request

from ultragray.errors import UltragrayError
from ultragray_service.core.streams import MAX_MESSAGE_BYTES
from ultragray_service.core.unread import hold_little
from ultragray_service.errors import HeadersTooLarge, RequestMalformed, RequestTooSlow, TargetTooLong, statuses_of
from ultragray_service.http.problems import problem_response
from ultragray_service.listening import Acceptor, Connections, Patience, Place
from ultragray_service.settings import Settings
from ultragray_service.telemetry.logs import choose_request_id, request_id
from ultragray_service.telemetry.metrics import Metrics
from ultragray_service.tls import CertificateWatch

HAND_OVER = "ultragray.hand_over"  # of an ASGI message with bytes: to return once the client has taken it
_FRAGMENTS = 32  # of a message that is handed over
_PINGS = 2
_LOOK_EVERY_S = 0.25


class PromptWebSocket(WebSocketsSansIOProtocol):
    """A WebSocket that buffers next to nothing: whoever sends waits until the kernel has taken the whole message.

    A message that is handed over waits longer, for pongs. Some libraries answer pings when the caller reads, which
    suffices; others read ahead until so many fragments (Python's websockets: 16) wait for the caller, which every
    message therefore has more than. Such a library may still read a ping that comes together with the message; it has
    stopped when the next one comes.
    """

    _pong: asyncio.Future[None] | None = None
    _ping = 0  # the number of the last one, which it carries

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        hold_little(transport)

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._answered()

    def handle_pong(self, event: Frame) -> None:
        if bytes(event.data) == self._ping_payload:
            self._answered()
        else:
            super().handle_pong(event)

    async def send(self, message: Any) -> None:
        is_handed_over = message.get(HAND_OVER, False)
        try:
            if not is_handed_over or "bytes" not in message:
                await super().send(message)
                await self.writable.wait()
                return
            self._send_fragments(message["bytes"])
            await self.writable.wait()
            for _ in range(_PINGS):
                await self._be_answered()
        except InvalidState:
            raise ClientDisconnected from None

    def _send_fragments(self, data: bytes) -> None:
        step = -(-len(data) // _FRAGMENTS)
        self.conn.send_binary(data[:step], fin=False)
        for start in range(step, len(data), step):
            self.conn.send_continuation(data[start : start + step], fin=start + step >= len(data))
        self._write()

    async def _be_answered(self) -> None:
        """Waits for the pong of a new ping, or for the end of the connection.

        Not while nobody reads on, such as a stream with too many refusals to send: the pong is behind what is unread.
        """
        self._pong = self.loop.create_future()
        self._ping += 1
        self.conn.send_ping(self._ping_payload)
        self._write()
        while not self._pong.done():
            was_paused = self.read_paused
            await asyncio.wait({self._pong}, timeout=_LOOK_EVERY_S)
            if was_paused and self.read_paused:
                return

    @property
    def _ping_payload(self) -> bytes:
        return b"taken %d" % self._ping

    def _answered(self) -> None:
        if self._pong is not None and not self._pong.done():
            self._pong.set_result(None)

    def _write(self) -> None:
        self.transport.write(b"".join(self.conn.data_to_send()))


MAX_PIPELINED = 32
MAX_TARGET_BYTES = 16 * 1024
_MAX_UNWANTED_BYTES = 2**20  # of a body whose request was answered already: a longer one costs the connection
_LINGER_S = 1.0  # in which a client that still sends can read its answer


Refused = Callable[[UltragrayError], bytes]  # the answer to a refused request, which it counts


class BoundedHttp(HttpToolsProtocol):
    """One connection. `look` must be called every second or so.

    A head is counted while it comes, and nothing beyond the limit reaches the parser. The same count bounds whatever
    else brings neither a head to its end nor a body on. Trailers are bounded like a head, and thrown away.
    """

    def __init__(self, *arguments: Any, limits: Settings, refused: Refused, place: Place, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.ws_protocol_class: Any = partial(_BoundedWebSocket, limits=limits, refused=refused, place=place)
        self._limits, self._refused, self._place = limits, refused, place
        self._in_head = True
        self._head_since: float | None = self.loop.time()
        self._looked_at = self.loop.time()
        self._idle_bytes = 0  # since the request came on
        self._body_bytes = 0  # since the last look
        self._keep_alive = False  # once the body is whole
        self._trailers = self._trailer_bytes = 0
        self._refused_for: UltragrayError | None = None
        self._is_over = False
        self._receiving = Patience(limits.min_bytes_per_s, limits.transfer_patience_s)
        self._sending = _Sending(limits)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(_Closing(transport, self._linger))  # type: ignore[arg-type]  # it has all that a transport has

    def connection_lost(self, exc: Exception | None) -> None:
        self._place.close()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        if self._in_head:
            if self._head_since is None:
                self._head_since = self.loop.time()
            room = self._limits.max_header_bytes - self._idle_bytes
            if len(data) > room:
                self._take(data[:room])
                if self._in_head and not self._is_over:
                    self._refuse(self._head_too_large())
                data = data[room:]
        self._take(data)

    def _take(self, data: bytes) -> None:
        if self._is_over or self.transport.is_closing():
            return
        self._idle_bytes += len(data)
        self._unset_keepalive_if_required()
        self._parse(data)
        if self._idle_bytes > self._limits.max_header_bytes and not self._is_over:
            self._refuse(self._head_too_large())

    def _parse(self, data: bytes) -> None:
        try:
            self.parser.feed_data(data)
        except httptools.HttpParserError:
            self.send_400_response("")
        except httptools.HttpParserUpgrade as pause:
            if self._should_upgrade():
                self.handle_websocket_upgrade()
            elif not _has_body(self.headers):  # an ordinary request; uvicorn would forget what came behind it
                self._parse(data[pause.args[0] :])
            else:  # the parser takes no body of a handshake
                self.cycle.keep_alive = False

    def on_message_begin(self) -> None:
        if self._head_since is None:  # it came with the end of the request before
            self._head_since = self.loop.time()
        super().on_message_begin()

    def on_url(self, url: bytes) -> None:
        super().on_url(url)
        if len(self.url) > MAX_TARGET_BYTES:
            self._stop_parsing(TargetTooLong(f"the target of a request may have at most {MAX_TARGET_BYTES} bytes"))

    def on_header(self, name: bytes, value: bytes) -> None:
        if self._in_head:
            super().on_header(name, value)
            return
        self._trailers += 1
        self._trailer_bytes += len(name) + len(value)
        if self._trailers > self._limits.max_headers or self._trailer_bytes > self._limits.max_header_bytes:
            self._stop_parsing(self._head_too_large())

    def on_headers_complete(self) -> None:
        if len(self.headers) > self._limits.max_headers:
            self._stop_parsing(self._head_too_large())
        self._in_head = False
        self._head_since = None
        self._idle_bytes = self._trailers = self._trailer_bytes = 0
        self._receiving.renew()
        earlier = self.cycle
        super().on_headers_complete()
        if self.cycle is not earlier:  # no upgrade
            self._keep_alive = self.cycle.keep_alive
            self.cycle.keep_alive = self._keep_alive and not _may_be_long(self.headers)
        if len(self.pipeline) > MAX_PIPELINED:
            self._stop_parsing(RequestMalformed(f"at most {MAX_PIPELINED} requests may wait for their turn"))

    def on_body(self, body: bytes) -> None:
        self._idle_bytes = 0
        self._body_bytes += len(body)
        super().on_body(body)

    def on_message_complete(self) -> None:
        self._in_head = True
        self._idle_bytes = 0
        if self.cycle is not None:
            self.cycle.keep_alive = self._keep_alive
        super().on_message_complete()

    def _stop_parsing(self, error: UltragrayError) -> None:
        self._refused_for = error
        raise ValueError  # the parser hands over to `send_400_response`

    def _should_upgrade(self) -> bool:
        """A handshake has no body, and no request before it waits for an answer: else it is an ordinary request."""
        is_alone = self.cycle is None or self.cycle.response_complete
        return is_alone and not self.pipeline and not _has_body(self.headers) and super()._should_upgrade()

    def send_400_response(self, msg: str) -> None:
        self._refuse(self._refused_for or RequestMalformed("this is no HTTP request that can be read"))

    def timeout_keep_alive_handler(self) -> None:
        """Closes a connection that waits for a request. Of one that has begun, `look` says what is wrong."""
        if self._head_since is None:
            super().timeout_keep_alive_handler()

    def look(self, now: float) -> None:
        elapsed_s, self._looked_at = now - self._looked_at, now
        body_bytes, self._body_bytes = self._body_bytes, 0
        limits = self._limits
        if self._sending.is_stalled(self.transport, elapsed_s):
            self.transport.abort()
        elif self._is_over:
            pass
        elif self._in_head:
            if self._head_since is not None and now - self._head_since > limits.header_timeout_s:
                self._refuse(RequestTooSlow(f"the head of a request must come within {limits.header_timeout_s:g} s"))
        elif not self.flow.read_paused and self._receiving.is_over(body_bytes, elapsed_s):
            self._refuse(RequestTooSlow(f"a body must come at {limits.min_bytes_per_s:g} bytes a second or faster"))

    def _head_too_large(self) -> HeadersTooLarge:
        limits = self._limits
        return HeadersTooLarge(
            f"the head of a request may have at most {limits.max_header_bytes} bytes and {limits.max_headers} headers"
        )

    def _refuse(self, error: UltragrayError) -> None:
        """Says why, where no other answer is due, and closes. What still comes is thrown away."""
        self._unset_keepalive_if_required()
        cycle = self.cycle
        is_due = cycle is not None and not cycle.response_complete
        if self._in_head:
            has_begun = self.scope is not None or self._idle_bytes > 0
            can_answer = has_begun and not is_due
        else:
            can_answer = is_due and cycle.more_body and not cycle.response_started
        if is_due:
            cycle.disconnected = True
            cycle.message_event.set()
        self.pipeline.clear()
        if can_answer:
            self.transport.write(self._refused(error))
        self._end()

    def _linger(self) -> bool:
        """Whether the connection closes only after a moment: its client, still sending, may read the answer first."""
        if self._in_head:
            return False
        if not self._is_over:
            self._end()
        return True

    def _end(self) -> None:
        """Says that nothing more is sent, throws away what still comes, and closes a moment later."""
        self._is_over = True
        self.flow.resume_reading()
        _say_no_more(self.transport, self.loop)


def _say_no_more(transport: Any, loop: asyncio.AbstractEventLoop) -> asyncio.TimerHandle:
    """Ends the side of a connection that sends, and the connection a moment later.

    A connection that is closed with bytes unread is reset, and a client that is still sending then loses its answer.
    """
    if transport.can_write_eof() and not transport.is_closing():
        transport.write_eof()
    return loop.call_later(_LINGER_S, transport.abort)


class _Closing:
    """A transport that drops what is written once it closes, and closes later where `linger` says so."""

    def __init__(self, transport: Any, linger: Callable[[], bool]) -> None:
        self._transport, self._linger = transport, linger
        self._has_ended = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)

    def write(self, data: bytes) -> None:
        if not self._has_ended and not self._transport.is_closing():
            self._transport.write(data)

    def is_closing(self) -> bool:
        return self._has_ended or bool(self._transport.is_closing())

    def close(self) -> None:
        if not self._linger():
            self._transport.close()

    def write_eof(self) -> None:
        self._has_ended = True
        self._transport.write_eof()


class _BoundedWebSocket(PromptWebSocket):
    """One connection. `look` must be called every second or so.

    Frames that carry nothing are counted: pings, pongs that answer none of ours, empty fragments. Whoever sends more
    than MAX_EMPTY_FRAMES at once, and EMPTY_FRAMES_PER_S in the long run, is closed with 1008. The rest is not read,
    and the connection keeps its place for a moment: a client that comes again at once would cost a handshake each time.
    What follows a message that breaks the protocol or is too long is read for a moment, and thrown away.
    """

    _is_over = False

    def __init__(self, *arguments: Any, limits: Settings, refused: Refused, place: Place, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._refused, self._place = refused, place
        self._looked_at = self.loop.time()
        self._sending = _Sending(limits)
        self._empty_frames, self._counted_at = 0.0, self._looked_at

    def data_received(self, data: bytes) -> None:
        for start in range(0, len(data), _PIECE_BYTES):
            if self._is_over or self.transport.is_closing():
                return
            super().data_received(data[start : start + _PIECE_BYTES])

    def handle_ping(self) -> None:
        self._count_empty()
        super().handle_ping()

    def handle_pong(self, event: Frame) -> None:
        if bytes(event.data) not in (self._ping_payload, self.pending_ping_payload):
            self._count_empty()
        super().handle_pong(event)

    def handle_cont(self, event: Frame) -> None:
        if not event.data:
            self._count_empty()
        super().handle_cont(event)

    def handle_parser_exception(self) -> None:
        closed = self.conn.close_sent
        assert closed is not None
        self.queue.put_nowait({"type": "websocket.disconnect", "code": closed.code, "reason": closed.reason})
        self._write()
        self._is_over = self.close_sent = True
        self.transport.resume_reading()
        self.close_timer = _say_no_more(self.transport, self.loop)

    def _count_empty(self) -> None:
        now = self.loop.time()
        remaining = self._empty_frames - EMPTY_FRAMES_PER_S * (now - self._counted_at)
        self._empty_frames, self._counted_at = max(0.0, remaining) + 1.0, now
        if self._empty_frames > MAX_EMPTY_FRAMES and not self._is_over and not self.transport.is_closing():
            self._is_over = True
            self.conn.fail(_POLICY_VIOLATION, "too many pings, pongs or empty frames")
            self._write()
            self.transport.pause_reading()
            self.loop.call_later(_LINGER_S, self.transport.close)

    def connection_lost(self, exc: Exception | None) -> None:
        self._place.close()
        super().connection_lost(exc)

    def handle_connect(self, event: Request) -> None:
        try:
            self.conn.process_request(event)
        except InvalidHandshake:
            error = RequestMalformed("the headers are no handshake of a WebSocket of version 13 (RFC 6455)")
            self.handshake_initiated = self.handshake_complete = self.close_sent = True
            self.transport.write(self._refused(error))
            self.transport.close()
        else:
            super().handle_connect(event)

    def look(self, now: float) -> None:
        elapsed_s, self._looked_at = now - self._looked_at, now
        if self._sending.is_stalled(self.transport, elapsed_s):
            self.transport.abort()


class _Sending:
    def __init__(self, limits: Settings) -> None:
        self._patience = Patience(limits.min_bytes_per_s, limits.transfer_patience_s)
        self._waiting_bytes = 0

    def is_stalled(self, transport: asyncio.Transport, elapsed_s: float) -> bool:
        before, self._waiting_bytes = self._waiting_bytes, transport.get_write_buffer_size()
        if not before or not self._waiting_bytes or self._waiting_bytes > before:  # more comes when there is room only
            self._patience.renew()
            return False
        return self._patience.is_over(before - self._waiting_bytes, elapsed_s)


def _has_body(headers: list[tuple[bytes, bytes]]) -> bool:
    return any(name == b"transfer-encoding" or (name == b"content-length" and value != b"0") for name, value in headers)


def _may_be_long(headers: list[tuple[bytes, bytes]]) -> bool:
    """Whether the body after these headers may be longer than what is worth reading for its connection alone."""
    return any(
        name == b"transfer-encoding" or (name == b"content-length" and int(value) > _MAX_UNWANTED_BYTES)
        for name, value in headers
    )


def refusal_bytes(error: UltragrayError, default_headers: list[tuple[bytes, bytes]]) -> bytes:
    token = request_id.set(choose_request_id(None))
    try:
        response = problem_response(error, {"Connection": "close", "X-Request-Id": request_id.get()})
    finally:
        request_id.reset(token)
    headers = [*default_headers, *response.raw_headers]
    lines = [STATUS_LINE[response.status_code], *(b"%s: %s\r\n" % header for header in headers), b"\r\n"]
    return b"".join([*lines, bytes(response.body)])


MAX_EMPTY_FRAMES, EMPTY_FRAMES_PER_S = 100, 10.0  # of a WebSocket's client
_PIECE_BYTES = 1024  # that are parsed before what they hold is counted
_POLICY_VIOLATION = 1008

_TICKS_PER_LOOK = 10  # of 0.1 s


class HttpServer(uvicorn.Server):
    """Serves an application. Has no signal handlers: one place decides when all servers stop."""

    def __init__(
        self, app: ASGIApp, settings: Settings, metrics: Metrics, certificates: CertificateWatch | None, flush_s: float
    ) -> None:
        super().__init__(
            uvicorn.Config(
                app,
                http=BoundedHttp,
                ws=PromptWebSocket,
                ws_max_size=MAX_MESSAGE_BYTES,
                ws_per_message_deflate=False,  # speckle does not shrink
                lifespan="off",
                log_config=None,
                access_log=False,
                server_header=False,
                proxy_headers=False,  # anybody on this machine could write another's address there
                timeout_keep_alive=int(settings.idle_timeout_s),
                timeout_graceful_shutdown=int(flush_s),
            )
        )
        self._settings, self._metrics, self._certificates = settings, metrics, certificates

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begins to accept. uvicorn's own would not know whom it accepts."""
        limits, refusal = self._settings, self._refusal
        connections = Connections(limits.max_connections, limits.max_connections_per_address)
        protocol = partial(BoundedHttp, self.config, self.server_state, {}, limits=limits, refused=refusal)
        means: dict[str, Any] = {"refusal": refusal, "send_patience_s": limits.transfer_patience_s, "tls": self._tls}
        servers: list[Any] = [Acceptor(one, connections, protocol, **means) for one in sockets or ()]
        self.servers = servers
        self.started = True

    async def on_tick(self, counter: int) -> bool:
        if counter % _TICKS_PER_LOOK == 0:
            now = asyncio.get_running_loop().time()
            connections: set[Any] = self.server_state.connections
            for connection in tuple(connections):
                connection.look(now)
        return await super().on_tick(counter)

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    def _tls(self) -> ssl.SSLContext | None:
        return None if self._certificates is None else self._certificates.current.http_context

    def _refusal(self, error: UltragrayError) -> bytes:
        self._metrics.count_request("http", "refused", str(statuses_of(error).http), 0.0)
        return refusal_bytes(error, self.server_state.default_headers)

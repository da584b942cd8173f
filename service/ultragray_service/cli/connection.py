"""The connection of commands to a running service: the options that find it, requests over HTTP, and TLS.

The commands ask over HTTP, not over gRPC as the Python client does: what users have is the URL of the service, often of
a proxy that lets nothing else through; scene files, pictures and the documents that --json prints are HTTP's alone;
and these commands are of the core, which needs no gRPC. The standard library is enough for them.
"""

from __future__ import annotations

import contextlib
import http.client
import ipaddress
import json
import ssl
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import wraps
from pathlib import Path
from typing import IO, Annotated, Any
from urllib.parse import quote, urlencode, urlsplit

import typer

from ultragray.errors import InvalidArgument, UltragrayError
from ultragray.files import atomic_path
from ultragray_service.cli.options import parameters_in, with_parameters
from ultragray_service.cli.terminal import Columns, Json, argument, examples, tell, tell_facts, tell_table, warn
from ultragray_service.environment import ADDRESS, API_KEY, CA, CLIENT_CERTIFICATE, CLIENT_KEY
from ultragray_workers.errors import NotReady


def client_context(ca: Path | None, certificate: Path | None, key: Path | None) -> ssl.SSLContext:
    """The certificates of a client; `ca` None: the system's. Raises InvalidArgument for files that cannot be used."""
    if (certificate is None) is not (key is None):
        raise InvalidArgument("--client-certificate and --client-key must be given together", field="client_key")
    try:
        context = ssl.create_default_context(cafile=ca)
    except OSError as error:
        raise InvalidArgument(f"--ca: {ca} holds no certificates ({_words(error)})", field="ca") from None
    if certificate is not None:
        try:
            context.load_cert_chain(certificate, key, password="")
        except OSError as error:
            raise InvalidArgument(
                f"--client-certificate: {certificate} and {key} are no certificate and its key ({_words(error)})",
                field="client_certificate",
            ) from None
    return context


def tls_problem(server: str, error: object) -> str | None:
    """The words for a connection that TLS prevented; None: for another reason."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return (
            f"{server} shows a certificate that is not to be trusted ({error.verify_message}): name its authority with "
            "--ca, and the service by a name of its certificate"
        )
    if isinstance(error, ssl.SSLError) and error.reason == "WRONG_VERSION_NUMBER":
        return f"{server} does not speak TLS: name it with http://"
    if isinstance(error, ssl.SSLError) and "ALERT" in (error.reason or ""):
        return f"{server} refuses the client's certificate, or its absence ({_words(error)}): see --client-certificate"
    return None


def cut_off_hint(server: str, error: object) -> str:
    """What may be behind a connection that a service cut off: it says no more where it misses TLS or a certificate."""
    if not isinstance(error, (http.client.BadStatusLine, ConnectionResetError)):
        return ""
    if server.startswith("https://"):
        return "; if it asks for a client's certificate, see --client-certificate"
    return "; if it speaks TLS, name it with https://"


def exposes_key(server: str) -> bool:
    """Whether others on the way to the URL can read a key that is sent there."""
    parts = urlsplit(server)
    if parts.scheme == "https" or parts.hostname == "localhost":
        return False
    try:
        return not ipaddress.ip_address(parts.hostname or "").is_loopback
    except ValueError:
        return True


def _words(error: OSError) -> str:
    return (error.reason if isinstance(error, ssl.SSLError) else error.strerror) or str(error)


JSON = "application/json"
_TIMEOUT_S = 60.0  # without a byte; event streams send a comment every 15 s
CHECK_TIMEOUT_S = 1800.0  # for the answer to an upload or the end of a recording, which is checked first
_BLOCK_BYTES = 1 << 20
_PAGE = 100

Count = Callable[[int], object]  # is told how many more bytes went through


class Connection:
    """Asks the service at an address. What it refuses is raised as UltragrayError with its sentence.

    Raises NotReady where nobody answers, and where the service is starting or stopping. `tls` None: the certificates
    that the system trusts. A key goes to the address that it was given for: redirections and proxies are not followed.
    """

    def __init__(self, address: str, api_key: str | None = None, tls: ssl.SSLContext | None = None) -> None:
        address = address if "://" in address else f"http://{address}"
        self._parts = urlsplit(address)
        if self._parts.scheme not in ("http", "https") or not self._parts.netloc:
            raise InvalidArgument(
                f"--address must be HOST:PORT or a URL such as http://127.0.0.1:8000, got {address!r}", field="address"
            )
        self.address = address.rstrip("/")
        self._tls = tls
        self._headers = {"Connection": "close"} | ({} if api_key is None else {"X-API-Key": api_key})

    def json(
        self, method: str, route: str, body: Mapping[str, Any] | None = None, timeout_s: float = _TIMEOUT_S
    ) -> Any:
        with self.open(method, route, body, timeout_s=timeout_s) as answer:
            return self._document(self.whole(answer))

    def text(self, route: str) -> str:
        with self.open("GET", route, accept="*/*") as answer:
            return self.whole(answer).decode("utf-8", "replace")

    def whole(self, answer: http.client.HTTPResponse) -> bytes:
        try:
            return answer.read()
        except (OSError, http.client.HTTPException) as error:
            raise NotReady(f"{self.address} broke off its answer ({_in_words(error)})") from error

    def listed(self, route: str, key: str, limit: int | None = None, **query: str) -> list[dict[str, Any]]:
        """The items of all pages of a list, at most `limit`; `key` names them in a page."""
        items: list[dict[str, Any]] = []
        token: str | None = ""
        while limit is None or len(items) < limit:
            size = _PAGE if limit is None else min(limit - len(items), _PAGE)
            page = self.json("GET", f"{route}?{urlencode({**query, 'page_size': size, 'page_token': token})}")
            if not isinstance(page, dict) or key not in page:
                raise self._foreign()
            items += page[key]
            token = page.get("next_page_token")
            if not token:
                break
        return items

    def open(
        self,
        method: str,
        route: str,
        body: Mapping[str, Any] | None = None,
        accept: str = JSON,
        timeout_s: float = _TIMEOUT_S,
    ) -> http.client.HTTPResponse:
        content = None if body is None else json.dumps(body, default=str).encode()
        headers = {"Accept": accept} | ({} if content is None else {"Content-Type": JSON})
        return self._ask(method, route, content, headers, timeout_s)

    def events(self, route: str, name: str) -> Iterator[Any]:
        """The JSON of the events of that name; ends with the stream, or where the service goes away."""
        with self.open("GET", route, accept="text/event-stream") as answer:
            event = ""
            with contextlib.suppress(OSError, http.client.HTTPException):
                for line in answer:
                    key, _, value = line.decode("utf-8", "replace").rstrip("\r\n").partition(": ")
                    if key == "event":
                        event = value
                    elif key == "data" and event == name:
                        yield json.loads(value)

    def download(self, route: str, path: Path, progress: Callable[[int | None], Count]) -> int:
        """Write an answer to `path`, whole or not at all; its bytes. `progress`: of the size, then of blocks."""
        with self.open("GET", route, accept="*/*") as answer, atomic_path(path) as temporary:
            announced = answer.headers.get("Content-Length")
            size = None if announced is None else int(announced)
            count = progress(size)
            written = 0
            with temporary.open("wb") as file, contextlib.suppress(http.client.HTTPException):
                while block := answer.read(_BLOCK_BYTES):
                    file.write(block)
                    written += len(block)
                    count(len(block))
            if size is not None and written != size:
                raise NotReady(f"{self.address} broke off after {written:,} of {size:,} bytes of {path.name}")
        return written

    def upload(self, route: str, path: Path, count: Count) -> tuple[Any, bool]:
        """The JSON of the answer to a PUT of a file, which may come early, and whether something new was made of it."""
        headers = {"Content-Type": "application/octet-stream", "Content-Length": str(path.stat().st_size)}
        with path.open("rb") as file:
            body = _Counted(file, path.name, count)
            with self._ask("PUT", route, body, headers, CHECK_TIMEOUT_S) as answer:
                return self._document(self.whole(answer)), answer.status == 201

    def post(self, route: str, body: bytes) -> Any:
        """The JSON of the answer to bytes."""
        headers = {"Content-Type": "application/octet-stream"}
        with self._ask("POST", route, body, headers, _TIMEOUT_S) as answer:
            return self._document(self.whole(answer))

    def _ask(
        self, method: str, route: str, body: bytes | _Counted | None, headers: Mapping[str, str], timeout_s: float
    ) -> http.client.HTTPResponse:
        upload = body if isinstance(body, _Counted) else None
        try:
            where = self._parts.netloc
            connection = (
                http.client.HTTPSConnection(where, timeout=timeout_s, context=self._tls)
                if self._parts.scheme == "https"
                else http.client.HTTPConnection(where, timeout=timeout_s, blocksize=_BLOCK_BYTES)
            )
            with contextlib.ExitStack() as unless_answered:
                unless_answered.callback(connection.close)
                try:
                    connection.request(method, self._parts.path.rstrip("/") + route, body, {**self._headers, **headers})
                except (BrokenPipeError, ConnectionResetError, ssl.SSLError):
                    if upload is None or not upload.is_begun:
                        raise
                answer = connection.getresponse()
                unless_answered.pop_all()
            if connection.sock is not None:  # the answer has it
                connection.sock.close()
        except (OSError, http.client.HTTPException) as error:
            if upload is not None and upload.is_begun:
                raise NotReady(f"{self.address} closed the connection while {upload.name} was sent") from error
            raise self._unreachable(error) from error
        if answer.status >= 300:
            with answer:
                raise self._refusal(answer.status, self.whole(answer), answer.headers.get("Location"))
        return answer

    def _document(self, content: bytes) -> Any:
        try:
            return json.loads(content) if content else None
        except ValueError:
            raise self._foreign() from None

    def _foreign(self) -> UltragrayError:
        return UltragrayError(f"{self.address} answered, but not as an UltraG-Ray service does")

    def _unreachable(self, reason: object) -> UltragrayError:
        if (problem := tls_problem(self.address, reason)) is not None:
            return UltragrayError(problem)
        if isinstance(reason, http.client.BadStatusLine) and not isinstance(reason, http.client.RemoteDisconnected):
            hint = cut_off_hint(self.address, reason)
            return UltragrayError(f"{self.address} does not speak HTTP; if it is the port of gRPC, give HTTP's{hint}")
        return NotReady(
            f"no service answers at {self.address} ({_in_words(reason)}); start one with `ultragray serve`, or name it "
            f"with --address{cut_off_hint(self.address, reason)}"
        )

    def _refusal(self, status: int, content: bytes, elsewhere: str | None) -> UltragrayError:
        if elsewhere is not None and status < 400:
            return UltragrayError(f"{self.address} redirects to {elsewhere}: give the address of the service itself")
        try:
            problem = json.loads(content)
            detail, field = str(problem["detail"]), problem.get("field")
        except (ValueError, LookupError, TypeError):
            return UltragrayError(
                f"{self.address} answered with status {status}, but not as an UltraG-Ray service does"
            )
        return (NotReady if status == 503 else UltragrayError)(detail, field=field)


class _Counted:
    """A file that tells how much of it was read."""

    def __init__(self, file: IO[bytes], name: str, count: Count) -> None:
        self._file, self.name, self._count = file, name, count
        self.is_begun = False

    def read(self, size: int = -1) -> bytes:
        block = self._file.read(size)
        self.is_begun = True
        self._count(len(block))
        return block


def route(*parts: str, suffix: str = "") -> str:
    """The path of a resource, below /v1; `suffix` stands behind it as it is. Raises InvalidArgument for no name."""
    for name in parts[1:2]:
        if not name or "/" in name:
            raise InvalidArgument(f"{parts[0]} have names of letters, digits, '.', '_' and '-', got {name!r}")
    return "/v1/" + "/".join(quote(part, safe="") for part in parts) + suffix


def _in_words(reason: object) -> str:
    if isinstance(reason, OSError) and reason.strerror:
        return reason.strerror.lower()
    return str(reason) or type(reason).__name__


CONNECTION, TLS = "Connection", "TLS"


def _option(help: str, envvar: str, panel: str, show_default: str | bool = False) -> Any:
    return typer.Option(help=help, envvar=envvar, rich_help_panel=panel, show_default=show_default)


def _connected(
    address: Annotated[str, _option("URL of the service.", ADDRESS, CONNECTION, True)] = "http://127.0.0.1:8000",
    api_key: Annotated[str | None, _option("Where the service asks for one.", API_KEY, CONNECTION)] = None,
    ca: Annotated[
        Path | None, _option("Authorities (PEM) that sign the service's certificate.", CA, TLS, "the system's")
    ] = None,
    client_certificate: Annotated[
        Path | None,
        _option("Certificate (PEM) of the client, where the service asks for one.", CLIENT_CERTIFICATE, TLS),
    ] = None,
    client_key: Annotated[Path | None, _option("Its key (PEM), not encrypted.", CLIENT_KEY, TLS)] = None,
) -> Connection:
    connection = Connection(address, api_key, client_context(ca, client_certificate, client_key))
    if api_key is not None and exposes_key(connection.address):
        warn(f"the API key travels unencrypted to {connection.address}, and whoever is on the way can read it")
    return connection


def with_connection(command: Callable[..., None]) -> Callable[..., None]:
    """Make a command of a function that takes a `connection` first: with the options of the connection."""
    options = parameters_in(_connected)

    @wraps(command)
    def run(**values: Any) -> None:
        connection = _connected(**{one.name: values.pop(one.name) for one in options})
        command(connection, **values)

    return with_parameters(run, [*(one for one in parameters_in(command) if one.name != "connection"), *options])


@dataclass(frozen=True)
class Resource:
    """A kind of things that a service keeps, and the commands that such kinds have alike."""

    app: typer.Typer
    kind: str  # plural: the command, the route, and the key of a list
    example: str  # of a name
    columns: Columns = field(default_factory=dict)
    metavar: str = "NAME"
    meaning: str = "Name of the {thing}."

    def add_list(self, meaning: str, *more: str) -> None:
        line = f"ultragray {self.kind} list"

        @self.app.command("list", help=meaning, epilog=examples(line, *more or (f"{line} --json | jq '.[].name'",)))
        @with_connection
        def list_all(connection: Connection, json: Json = False) -> None:
            items = connection.listed(f"/v1/{self.kind}", self.kind)
            tell_table(self.columns, items, as_json=json)

    def add_show(self, meaning: str, *more: str) -> None:
        def show(connection: Connection, name: str, json: Json = False) -> None:
            tell_facts(connection.json("GET", route(self.kind, name)), as_json=json)

        self._add("show", show, meaning, *more)

    def add_delete(self, meaning: str) -> None:
        def delete(connection: Connection, name: str, json: Json = False) -> None:
            connection.json("DELETE", route(self.kind, name))
            tell(f"{name} deleted", {"deleted": name}, as_json=json)

        self._add("delete", delete, meaning)

    def add_action(
        self,
        action: str,
        meaning: str,
        in_words: Callable[[dict[str, Any]], str],
        timeout_s: float = _TIMEOUT_S,
    ) -> None:
        """A command that has the service do something with one, and tells `in_words` what came of it."""

        def act(connection: Connection, name: str, json: Json = False) -> None:
            changed = connection.json("POST", route(self.kind, name, suffix=f":{action}"), timeout_s=timeout_s)
            tell(in_words(changed), changed, as_json=json)

        self._add(action, act, meaning)

    def _add(self, name: str, command: Callable[..., None], meaning: str, *more: str) -> None:
        thing = self.meaning.format(thing=self.kind.removesuffix("s"))
        command.__annotations__["name"] = Annotated[str, argument(thing, metavar=self.metavar)]
        line = f"ultragray {self.kind} {name} {self.example}"
        self.app.command(name, help=meaning, epilog=examples(line, *more))(with_connection(command))

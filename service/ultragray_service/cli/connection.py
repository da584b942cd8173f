"""The connection of commands to a running service: the options that find it, and requests over HTTP.

The commands ask over HTTP, not over gRPC as the Python client does: what users have is the URL of the service, often of
a proxy that lets nothing else through; scene files, pictures and the documents that `--json` prints are HTTP's alone;
and these commands are of the core, which needs no gRPC. The standard library is enough for them.
"""

from __future__ import annotations

import contextlib
import http.client
import inspect
import json
import ssl
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from functools import wraps
from pathlib import Path
from typing import IO, Annotated, Any, get_type_hints
from urllib.parse import quote, urlencode, urlsplit

import typer

from ultragray.errors import InvalidArgument, UltragrayError
from ultragray.files import atomic_path
from ultragray_service.cli.options import keyword, with_parameters
from ultragray_service.cli.terminal import warn
from ultragray_service.environment import ADDRESS, API_KEY, CA, CLIENT_CERTIFICATE, CLIENT_KEY
from ultragray_service.tls.client import client_context, cut_off_hint, exposes_key, tls_problem
from ultragray_workers.errors import NotReady

JSON = "application/json"
_TIMEOUT_S = 60.0  # without a byte; event streams send a comment every 15 s
_CHECK_TIMEOUT_S = 1800.0  # for the answer to an upload, which is checked first
_BLOCK_BYTES = 1 << 20
_PAGE = 100

Count = Callable[[int], object]  # is told how many more bytes went through


class Connection:
    """Asks the service at an address. What it refuses is raised as UltragrayError with its sentence.

    Raises NotReady where nobody answers, and where the service is starting or stopping. `tls` None: the certificates
    that the system trusts.
    """

    def __init__(self, address: str, api_key: str | None = None, tls: ssl.SSLContext | None = None) -> None:
        parts = urlsplit(address)
        if parts.scheme not in ("http", "https") or not parts.netloc:
            raise InvalidArgument(
                f"--address must be a URL such as http://127.0.0.1:8000, got {address!r}", field="address"
            )
        self.address = address.rstrip("/")
        self._tls = tls
        # A key goes to the address that it was given for: not on to where that redirects, nor by way of a proxy.
        self._opener = urllib.request.build_opener(
            urllib.request.ProxyHandler({}), _NoRedirect, urllib.request.HTTPSHandler(context=tls)
        )
        self._headers = {} if api_key is None else {"X-API-Key": api_key}

    def json(self, method: str, route: str, body: Mapping[str, Any] | None = None) -> Any:
        with self.open(method, route, body) as answer:
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
        found: list[dict[str, Any]] = []
        token: str | None = ""
        while limit is None or len(found) < limit:
            size = _PAGE if limit is None else min(limit - len(found), _PAGE)
            page = self.json("GET", f"{route}?{urlencode({**query, 'page_size': size, 'page_token': token})}")
            if not isinstance(page, dict) or key not in page:
                raise self._foreign()
            found += page[key]
            token = page.get("next_page_token")
            if not token:
                break
        return found

    def open(
        self, method: str, route: str, body: Mapping[str, Any] | None = None, accept: str = JSON
    ) -> http.client.HTTPResponse:
        content = None if body is None else json.dumps(body, default=str).encode()
        headers = self._headers | {"Accept": accept} | ({} if content is None else {"Content-Type": JSON})
        request = urllib.request.Request(self.address + route, content, headers, method=method)
        try:
            answer: http.client.HTTPResponse = self._opener.open(request, timeout=_TIMEOUT_S)
        except urllib.error.HTTPError as error:
            with error:
                raise self._refusal(error.code, error.read(), error.headers.get("Location")) from None
        except (OSError, http.client.HTTPException) as error:
            raise self._unreachable(error.reason if isinstance(error, urllib.error.URLError) else error) from error
        return answer

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
        """Write an answer to `path`, whole or not at all, and return its size in bytes.

        `progress` is given the size that the service announces, and returns what is told of each block.
        """
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
        """The JSON of the answer to a PUT of a file, and whether something new was made of it.

        A service that has seen enough answers before the file is sent: its refusal is raised all the same.
        """
        parts = urlsplit(self.address)
        secure = parts.scheme == "https"
        if secure:
            connection: http.client.HTTPConnection = http.client.HTTPSConnection(
                parts.netloc, timeout=_CHECK_TIMEOUT_S, context=self._tls
            )
        else:
            connection = http.client.HTTPConnection(parts.netloc, timeout=_CHECK_TIMEOUT_S, blocksize=_BLOCK_BYTES)
        headers = {"Content-Type": "application/octet-stream", "Content-Length": str(path.stat().st_size)}
        with path.open("rb") as file, contextlib.closing(connection):
            body = _Counted(file, count)
            try:
                try:
                    connection.request("PUT", parts.path + route, body, headers=self._headers | headers)
                except (BrokenPipeError, ConnectionResetError, ssl.SSLError):
                    if not body.is_begun:
                        raise
                answer = connection.getresponse()
                content = answer.read()
            except (OSError, http.client.HTTPException) as error:
                if body.is_begun:
                    raise NotReady(f"{self.address} closed the connection while {path.name} was sent") from error
                raise self._unreachable(error) from error
        if answer.status >= 300:
            raise self._refusal(answer.status, content, answer.headers.get("Location"))
        return self._document(content), answer.status == 201

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


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *_: object) -> None:
        return None


class _Counted:
    def __init__(self, file: IO[bytes], count: Count) -> None:
        self._file, self._count = file, count
        self.is_begun = False

    def read(self, size: int = -1) -> bytes:
        block = self._file.read(size)
        self.is_begun = True
        self._count(len(block))
        return block


def route(*parts: str, suffix: str = "") -> str:
    return "/v1/" + "/".join(quote(part, safe="") for part in parts) + suffix


def _in_words(reason: object) -> str:
    if isinstance(reason, OSError) and reason.strerror:
        return reason.strerror.lower()
    return str(reason) or type(reason).__name__


CONNECTION, TLS = "Connection", "TLS"


def _option(help: str, envvar: str, panel: str, show_default: str | bool) -> Any:
    return typer.Option(help=help, envvar=envvar, rich_help_panel=panel, show_default=show_default)


_OPTIONS = [
    keyword(
        "address",
        Annotated[str, _option("URL of the service.", ADDRESS, CONNECTION, True)],
        "http://127.0.0.1:8000",
    ),
    keyword(
        "api_key", Annotated[str | None, _option("Where the service asks for one.", API_KEY, CONNECTION, False)], None
    ),
    keyword(
        "ca",
        Annotated[
            Path | None,
            _option("Authorities (PEM) that sign the service's certificate.", CA, TLS, "the system's"),
        ],
        None,
    ),
    keyword(
        "client_certificate",
        Annotated[
            Path | None,
            _option("Certificate (PEM) of the client, where the service asks for one.", CLIENT_CERTIFICATE, TLS, False),
        ],
        None,
    ),
    keyword(
        "client_key", Annotated[Path | None, _option("Its key (PEM), not encrypted.", CLIENT_KEY, TLS, False)], None
    ),
]


def with_connection(command: Callable[..., None]) -> Callable[..., None]:
    """Make a command of a function that takes a `connection` first: with the options of the connection."""
    hints = get_type_hints(command, include_extras=True)
    own = [
        parameter.replace(annotation=hints[name], kind=parameter.KEYWORD_ONLY)
        for name, parameter in inspect.signature(command).parameters.items()
        if name != "connection"
    ]

    @wraps(command)
    def run(
        *,
        address: str,
        api_key: str | None,
        ca: Path | None,
        client_certificate: Path | None,
        client_key: Path | None,
        **given: Any,
    ) -> None:
        connection = Connection(address, api_key, client_context(ca, client_certificate, client_key))
        if api_key is not None and exposes_key(address):
            warn(f"the API key travels unencrypted to {address}, and whoever is on the way can read it")
        command(connection, **given)

    return with_parameters(run, [*own, *_OPTIONS])

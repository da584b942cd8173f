"""The jobs of a running service, over HTTP, with nothing but the standard library."""

from __future__ import annotations

import http.client
import json
import shutil
import ssl
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode, urlsplit

from ultragray.errors import InvalidArgument, UltragrayError
from ultragray.files.atomic import atomic_path
from ultragray_workers.errors import NotReady

from ..tls.client import cut_off_hint, tls_problem

_TIMEOUT_S = 60.0  # without a byte; event streams send a comment every 15 s


class JobClient:
    """Asks the service at a URL. What it refuses is raised as UltragrayError with its sentence.

    Raises NotReady where nobody answers, and where the service is starting or stopping. `tls` None: the certificates
    that the system trusts.
    """

    def __init__(self, server: str, api_key: str | None, tls: ssl.SSLContext | None = None) -> None:
        parts = urlsplit(server)
        if parts.scheme not in ("http", "https") or not parts.netloc:
            raise InvalidArgument(
                f"--server must be a URL such as http://127.0.0.1:8000, got {server!r}", field="server"
            )
        self._server = server.rstrip("/")
        self._tls = tls
        self._headers = {} if api_key is None else {"X-API-Key": api_key}

    def submit(self, body: dict[str, Any]) -> tuple[dict[str, Any], bool]:
        """The job, and whether it is new."""
        with self._open("POST", "/v1/jobs", body) as answer:
            return json.load(answer), answer.status == 201

    def get(self, job_id: str) -> dict[str, Any]:
        """The job as it is now."""
        return self._json("GET", _route(job_id))

    def cancel(self, job_id: str) -> dict[str, Any]:
        """The job, cancelled."""
        return self._json("POST", _route(job_id, ":cancel"))

    def retry(self, job_id: str) -> dict[str, Any]:
        """The job in its place."""
        return self._json("POST", _route(job_id, ":retry"))

    def delete(self, job_id: str) -> None:
        """Removes a finished job and its files."""
        self._open("DELETE", _route(job_id)).close()

    def jobs(self, *, state: str, kind: str, limit: int) -> list[dict[str, Any]]:
        """The newest jobs, at most `limit`."""
        found: list[dict[str, Any]] = []
        token = ""
        while len(found) < limit:
            query = {"state": state, "kind": kind, "page_size": min(limit - len(found), 100), "page_token": token}
            page = self._json("GET", f"/v1/jobs?{urlencode(query)}")
            found += page["jobs"]
            token = page["next_page_token"]
            if not token:
                break
        return found

    def log(self, job_id: str, max_bytes: int) -> str:
        """The end of its log."""
        with self._open("GET", _route(job_id, f"/log?max_bytes={max_bytes}")) as answer:
            return answer.read().decode("utf-8", "replace")

    def download(self, job_id: str, name: str, path: Path) -> None:
        """Writes an artifact to `path`, whole or not at all."""
        route = _route(job_id, f"/artifacts/{quote(name, safe='')}")
        with self._open("GET", route) as answer, atomic_path(path) as temporary, temporary.open("wb") as file:
            shutil.copyfileobj(answer, file)
            announced = answer.headers.get("Content-Length")
            if announced is not None and file.tell() != int(announced):
                raise NotReady(f"{self._server} broke off after {file.tell()} of {announced} bytes of {name}")

    def changes(self, job_id: str) -> Iterator[dict[str, Any]]:
        """The job at first and whenever it changed; ends after its final state, or where the service goes away."""
        with self._open("GET", _route(job_id, "/events")) as answer:
            event = ""
            try:
                for line in answer:
                    name, _, value = line.decode("utf-8", "replace").rstrip("\r\n").partition(": ")
                    if name == "event":
                        event = value
                    elif name == "data" and event == "progress":
                        yield json.loads(value)
            except (OSError, http.client.HTTPException):
                return

    def _json(self, method: str, route: str) -> dict[str, Any]:
        with self._open(method, route) as answer:
            document: dict[str, Any] = json.load(answer)
            return document

    def _open(self, method: str, route: str, body: dict[str, Any] | None = None) -> http.client.HTTPResponse:
        content = None if body is None else json.dumps(body, default=str).encode()
        headers = self._headers | ({} if content is None else {"Content-Type": "application/json"})
        request = urllib.request.Request(self._server + route, content, headers, method=method)
        try:
            answer: http.client.HTTPResponse = urllib.request.urlopen(request, timeout=_TIMEOUT_S, context=self._tls)
        except urllib.error.HTTPError as error:
            with error:
                raise _refusal(error.code, error.read(), self._server) from None
        except (OSError, http.client.HTTPException) as error:
            reason = error.reason if isinstance(error, urllib.error.URLError) else error
            if (problem := tls_problem(self._server, reason)) is not None:
                raise UltragrayError(problem) from error
            raise NotReady(
                f"no service answers at {self._server} ({reason}); start one with `ultragray serve`, or name it with "
                f"--server{cut_off_hint(self._server, reason)}"
            ) from error
        return answer


def _route(job_id: str, suffix: str = "") -> str:
    return f"/v1/jobs/{quote(job_id, safe='')}{suffix}"


def _refusal(status: int, content: bytes, server: str) -> UltragrayError:
    try:
        problem = json.loads(content)
        detail, field = str(problem["detail"]), problem.get("field")
    except (ValueError, LookupError, TypeError):
        return UltragrayError(f"{server} answered with status {status}, but not as an UltraG-Ray service does")
    return (NotReady if status == 503 else UltragrayError)(detail, field=field)

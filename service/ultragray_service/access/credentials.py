"""From what a client shows to who it is: its credential, who vouches for it, and what ends with it."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import logging
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

from ultragray.errors import UltragrayError
from ultragray_service.access.principals import LOCAL, Principal, Role
from ultragray_service.errors import IssuerUnavailable, Unauthenticated
from ultragray_workers.rounds import Rounds

STREAM_PROTOCOL = "ultragray.v1"  # WebSocket subprotocol
_KEY_PROTOCOL = "ultragray.key."


def offered_credential(authorizations: Sequence[str], api_keys: Sequence[str]) -> str | None:
    """The credential of `X-API-Key: KEY`, else of `Authorization: Bearer KEY`; None where there is none.

    Raises Unauthenticated for several of one kind: of which the service would take one, and a proxy another.
    """
    for header, values in (("X-API-Key", api_keys), ("Authorization", authorizations)):
        if len(values) > 1:
            raise Unauthenticated(f"{header} must be sent once, got {len(values)}", field=header)
    if api_keys or not authorizations:
        return api_keys[0] if api_keys else None
    scheme, _, token = authorizations[0].partition(" ")
    return token.strip() if scheme.lower() == "bearer" else None


def credentials_of_subprotocols(offered: Iterable[str]) -> list[str]:
    """The credentials that a page offers as subprotocols `ultragray.key.` + base64url of one.

    Browsers let a page set no header of a WebSocket but this one. What cannot be read is a key that nobody has.
    """
    return [_decoded(name[len(_KEY_PROTOCOL) :]) for name in offered if name.startswith(_KEY_PROTOCOL)]


def _decoded(coded: str) -> str:
    try:
        return base64.urlsafe_b64decode(coded + "=" * (-len(coded) % 4)).decode()
    except ValueError:
        return ""


class Authenticator(Protocol):
    """One source of principals: the key store, keys of the environment, an identity provider."""

    @property
    def is_used(self) -> bool:
        """Whether anybody was ever given a credential of this source: then nobody passes without one."""

    def authenticate(self, credential: str) -> Principal | None:
        """Whom a credential stands for; None where it is not of this source.

        It is asked at every request, on the thread of the event loop: it looks up, and waits for nothing.
        Raises Unauthenticated for a credential of this source that counts no more, with the reason.
        """


def digest_of(key: str) -> bytes:
    """What is kept of a key, and what it is found by.

    One round of SHA-256 is enough for keys of the key store: they are 256 random bits, which nobody finds by trying,
    however fast. Because keys are found by their digest, the time that it takes tells nothing about a key either.
    """
    return hashlib.sha256(key.encode()).digest()


class EnvironmentKeys:
    """The keys of the setting `api_keys`: for the first steps, and for containers. They are admins."""

    def __init__(self, keys: Sequence[str]) -> None:
        self._principals = {
            digest_of(key): Principal(f"environment:{number}", Role.ADMIN, "environment")
            for number, key in enumerate(keys, start=1)
        }

    @property
    def is_used(self) -> bool:
        return bool(self._principals)

    def authenticate(self, credential: str) -> Principal | None:
        return self._principals.get(digest_of(credential))


class Guard:
    """Knows whom a credential stands for. As long as no source is used, everybody is LOCAL."""

    def __init__(self, authenticators: Sequence[Authenticator]) -> None:
        self._authenticators = authenticators
        self._was_used = False

    @property
    def asks(self) -> bool:
        """Whether a credential is asked for. Once it was, it is: a list of keys that got lost opens no door."""
        self._was_used = self._was_used or any(source.is_used for source in self._authenticators)
        return self._was_used

    def authenticate(self, credential: str | None) -> Principal:
        """The principal of a credential. Raises Unauthenticated for one that is unknown, or counts no more."""
        if not self.asks:
            return LOCAL
        if credential is None:
            raise Unauthenticated(
                "an API key is required: send Authorization: Bearer KEY, or X-API-Key: KEY", field="Authorization"
            )
        for source in self._authenticators:
            principal = source.authenticate(credential)
            if principal is not None:
                if principal.expires_at_s is not None and principal.expires_at_s <= time.time():
                    raise Unauthenticated(f"the credential of {principal.name} has expired", field="Authorization")
                return principal
        raise Unauthenticated("the API key is not known", field="Authorization")


LOOK_INTERVAL_S = 1.0

_log = logging.getLogger("ultragray.access")


@dataclass(eq=False)
class _Session:
    credential: str | None
    expires_at_s: float | None  # time.time() in seconds; None: never
    task: asyncio.Task[Any]
    error: UltragrayError | None = None
    looks: Rounds = field(default_factory=lambda: Rounds("the watch over an open session", _log))


class Sessions:
    """Requests, calls and streams, each with the credential that it was let in with."""

    def __init__(self, guard: Guard) -> None:
        self._guard = guard
        self._open: set[_Session] = set()

    @contextmanager
    def held(self, principal: Principal, credential: str | None) -> Iterator[None]:
        """Cancels the body, and raises why, when the credential counts no more."""
        task = asyncio.current_task()
        assert task is not None
        session = _Session(None if principal is LOCAL else credential, principal.expires_at_s, task)
        self._open.add(session)
        try:
            yield
        except asyncio.CancelledError:
            if session.error is None:
                raise
            raise session.error from None
        finally:
            self._open.discard(session)

    async def follow(self) -> None:
        """Looks at all credentials every second, for ever."""
        while True:
            await asyncio.sleep(LOOK_INTERVAL_S)
            for session in list(self._open):
                with session.looks.round():
                    self._look(session)

    def _look(self, session: _Session) -> None:
        try:
            self._guard.authenticate(session.credential)
        except UltragrayError as error:
            is_expired = session.expires_at_s is not None and session.expires_at_s <= time.time()
            if isinstance(error, IssuerUnavailable) and not is_expired:
                return  # the issuer changed its keys, or is away: the next round may know more
            if session.error is None:
                session.error = error
                session.task.cancel()

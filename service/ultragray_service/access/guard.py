"""From credentials to principals: the sources that vouch for them, asked one after another."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from typing import Protocol

from ultragray_service.access.principal import LOCAL, Principal, Role
from ultragray_service.errors import Unauthenticated


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
                "an API key is required: send Authorization: Bearer KEY, or X-API-Key: KEY",
                field="Authorization",
            )
        for source in self._authenticators:
            principal = source.authenticate(credential)
            if principal is not None:
                if principal.expires_at_s is not None and principal.expires_at_s <= time.time():
                    raise Unauthenticated(f"the credential of {principal.name} has expired", field="Authorization")
                return principal
        raise Unauthenticated("the API key is not known", field="Authorization")

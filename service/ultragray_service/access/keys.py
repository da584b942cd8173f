"""Named API keys in the jobs' database: made, listed, revoked; and a copy in memory to check requests with."""

from __future__ import annotations

import json
import logging
import re
import secrets
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from types import MappingProxyType

import sqlalchemy as sa

from ultragray.contract import described
from ultragray.errors import InvalidArgument
from ultragray_service.access.audit import DatabaseWatch
from ultragray_service.access.credentials import digest_of
from ultragray_service.access.principals import Number, Principal, Role
from ultragray_service.errors import Unauthenticated
from ultragray_workers.jobs.owners import tell_change
from ultragray_workers.jobs.tables import CHANGES, KEYS
from ultragray_workers.rounds import Rounds

_PREFIX = "ultragray_"  # so that people, and those who search files for secrets, know one when they see it
_RANDOM_BYTES = 32
_ID_BYTES = 4
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,63}")  # no colon: see Principal
NO_LIMITS: Mapping[str, Number | None] = MappingProxyType({})
_DAY_S = 86_400.0


@dataclass(frozen=True, kw_only=True)
class Key:
    """An API key as its row has it; times are time.time() in seconds."""

    id: str
    name: str = described("Whose it is.")
    role: Role
    created_at_s: float
    expires_at_s: float | None = None
    revoked_at_s: float | None = None
    last_used_at_s: float | None = described("To the minute or so.", None)
    limits: Mapping[str, Number | None] = described("Its own, in place of those of all keys.", factory=dict)

    def is_valid(self, now_s: float) -> bool:
        return self.revoked_at_s is None and (self.expires_at_s is None or now_s < self.expires_at_s)


class KeyStore:
    """The keys of a database. Its methods block."""

    def __init__(self, engine: sa.Engine) -> None:
        self._engine = engine

    def create(
        self, name: str, role: Role, expires_days: float | None, limits: Mapping[str, Number | None] = NO_LIMITS
    ) -> tuple[Key, str]:
        """A new key and its secret, which nobody can read again. Raises InvalidArgument for a name that none may have.

        One name may have several keys: the new one while the old one is replaced.
        """
        if not NAME.fullmatch(name):
            raise InvalidArgument(
                f"name must be 1 to 64 letters, digits, '.', '_', '@', '-', the first a letter or digit, got {name!r}",
                field="name",
            )
        now_s = time.time()
        secret = _PREFIX + secrets.token_urlsafe(_RANDOM_BYTES)
        expires_at_s = None if expires_days is None else now_s + expires_days * _DAY_S
        key = Key(
            id=secrets.token_hex(_ID_BYTES),
            name=name,
            role=role,
            created_at_s=now_s,
            expires_at_s=expires_at_s,
            limits=dict(limits),
        )
        row = {**asdict(key), "digest": digest_of(secret).hex(), "role": role.value}
        row["limits"] = json.dumps(key.limits) if limits else None
        with self._engine.begin() as connection:
            connection.execute(sa.insert(KEYS).values(row))
            tell_change(connection)
        return key, secret

    def revoke(self, name_or_id: str) -> list[Key]:
        """Revokes the key of an id, or all of a name; those that were valid. Raises InvalidArgument for none."""
        now_s = time.time()
        matches = [key for key in self.keys().values() if name_or_id in (key.id, key.name)]
        if not matches:
            raise InvalidArgument(f"there is no key of the name or id {name_or_id!r}", field="name")
        revoked = [key for key in matches if key.revoked_at_s is None]
        with self._engine.begin() as connection:
            chosen = KEYS.c.id.in_([key.id for key in revoked])
            connection.execute(sa.update(KEYS).where(chosen).values(revoked_at_s=now_s))
            tell_change(connection)
        return [key for key in revoked if key.is_valid(now_s)]

    def keys(self) -> dict[bytes, Key]:
        """All keys by their digests, also those that are revoked or expired; oldest first."""
        with self._engine.connect() as connection:
            return read_keys(connection)

    def note_uses(self, last_used_at_s: Mapping[str, float]) -> None:
        if last_used_at_s:
            with self._engine.begin() as connection:
                connection.execute(
                    sa.update(KEYS).where(KEYS.c.id == sa.bindparam("key_id")),
                    [{"key_id": id, "last_used_at_s": at_s} for id, at_s in last_used_at_s.items()],
                )


def read_keys(connection: sa.Connection) -> dict[bytes, Key]:
    keys = {}
    for row in connection.execute(sa.select(KEYS).order_by(KEYS.c.created_at_s, KEYS.c.id)).mappings():
        values = {**row, "role": Role(row["role"]), "limits": json.loads(row["limits"] or "{}")}
        digest = bytes.fromhex(values.pop("digest"))
        keys[digest] = Key(**values)
    return keys


class KnownKeys:
    """An Authenticator: the keys as they were read last."""

    def __init__(self) -> None:
        self._keys: Mapping[bytes, Key] = {}
        self._principals: Mapping[bytes, Principal] = {}
        self._used_at_s: dict[str, float] = {}

    @property
    def is_used(self) -> bool:
        return bool(self._keys)

    def replace(self, keys: Mapping[bytes, Key]) -> None:
        """From now on these are the keys. May be called from any thread."""
        self._principals = {
            digest: Principal(key.name, key.role, key.id, key.expires_at_s, tuple(key.limits.items()))
            for digest, key in keys.items()
            if key.revoked_at_s is None
        }
        self._keys = keys

    def authenticate(self, credential: str) -> Principal | None:
        digest = digest_of(credential)
        principal = self._principals.get(digest)
        if principal is not None:
            self._used_at_s[principal.source] = time.time()
        elif digest in self._keys:
            raise Unauthenticated("the API key was revoked", field="Authorization")
        return principal

    def take_uses(self) -> dict[str, float]:
        """When keys were used last, by their ids, since the last call."""
        uses, self._used_at_s = self._used_at_s, {}
        return dict(uses)  # a request may still be writing into the other one


# The copy in memory of what the jobs' database knows of keys, owners and registrations, a second or two old.
# Requests are checked against the copy: no frame waits for the database. While the database is away the last copy
# holds, and so do the times at which keys expire.
INTERVAL_S = 1.0
_USES_EVERY = 30  # intervals
_COPIED = "keys, owners and registrations"

_log = logging.getLogger("ultragray.access")


class Snapshot:
    """Reads what is copied again whenever something of it changed, in a thread of its own."""

    def __init__(self, engine: sa.Engine, keys: KnownKeys, copies: Sequence[Callable[[sa.Connection], None]]) -> None:
        """Fills `keys` and calls `copies`; the first copy is there when this returns. Raises DatabaseUnavailable."""
        self._engine, self._keys, self._copies = engine, keys, copies
        self._number: int | None = None
        self._database = DatabaseWatch(f"{_COPIED} stay as they are for now", f"{_COPIED} are read again", _log)
        self._stop = threading.Event()
        self.refresh()
        self._thread = threading.Thread(target=self._run, name="access", daemon=True)
        self._thread.start()

    def refresh(self) -> None:
        """Reads what changed since the last call. Raises DatabaseUnavailable."""
        with self._engine.connect() as connection:
            number = connection.execute(sa.select(CHANGES.c.number)).scalar()  # first: what follows is as new or newer
            if number != self._number:
                self._keys.replace(read_keys(connection))
                for copy in self._copies:
                    copy(connection)
                self._number = number

    def close(self) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        rounds, round_number = Rounds(f"the watch over {_COPIED}", _log), 0
        while not self._stop.wait(INTERVAL_S):
            round_number += 1
            with rounds.round(), self._database.attempt():
                self.refresh()
                if round_number % _USES_EVERY == 0:
                    KeyStore(self._engine).note_uses(self._keys.take_uses())

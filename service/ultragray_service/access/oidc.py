"""Tokens of an OpenID Connect issuer: its keys, fetched in the background; its claims, mapped to a role.

PyJWT verifies. Its PyJWKClient does not fetch here: it does so where a token is checked, which is the event loop, and
takes an answer of any length.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import re
import ssl
import time
import urllib.request
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import jwt

from ultragray.errors import InvalidArgument
from ultragray_service.access.credentials import digest_of
from ultragray_service.access.principals import Principal, Role, is_loopback
from ultragray_service.errors import IssuerUnavailable, PermissionDenied, Unauthenticated
from ultragray_workers.rounds import Rounds


def check_url(url: str, field: str) -> str:
    """Raises InvalidArgument unless encrypted, or of this machine."""
    parts = urlsplit(url)
    if not parts.hostname or (parts.scheme != "https" and not (parts.scheme == "http" and is_loopback(parts.hostname))):
        raise InvalidArgument(f"{field} must be a URL that begins with https://, got {url!r}", field=field)
    return url


def parse_roles(mapping: Sequence[str]) -> dict[str, Role]:
    roles = {}
    for item in mapping:
        value, equals, role = item.rpartition("=")
        if not value or not equals or role not in {one.value for one in Role}:
            raise InvalidArgument(
                f"oidc_roles must be of the form VALUE=ROLE, ROLE one of {', '.join(Role)}, got {item!r}",
                field="oidc_roles",
            )
        roles[value] = Role(role)
    return roles


def claim_at(claims: Mapping[str, Any], path: str) -> Any:
    """The value of a claim: of its whole name, which may hold dots, else along its parts."""
    if path in claims:
        return claims[path]
    value: Any = claims
    for part in path.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    return value


def highest_role(values: Any, roles: Mapping[str, Role]) -> Role | None:
    """The highest role that a claim gives: a list of values, or a text of several with spaces between them."""
    names = values.split() if isinstance(values, str) else values if isinstance(values, list) else []
    claimed_roles = [roles[value] for value in names if isinstance(value, str) and value in roles]
    return max(claimed_roles, key=list(Role).index, default=None)


DISCOVERY_PATH = "/.well-known/openid-configuration"
REFRESH_S = 300.0
LEAST_INTERVAL_S = 5.0  # between two fetches, however many tokens name keys that are not known
RETRY_S = 15.0  # while the issuer does not answer
_CONNECT_TIMEOUT_S = 5.0
_ANSWER_TIMEOUT_S = 15.0
_LARGEST_ANSWER_BYTES = 2**19
_LEAST_RSA_BITS = 2048
_MAX_QUEUE = 100
_SIGNATURES = {  # that a key of a kind can make, by the class that JSON Web Keys know it as; nothing symmetric
    "RSA": ("RS256", "RS384", "RS512", "PS256", "PS384", "PS512"),
    "P-256": ("ES256",),
    "P-384": ("ES384",),
    "P-521": ("ES512",),
    "Ed25519": ("EdDSA",),
}

_log = logging.getLogger("ultragray.access")


@dataclass(frozen=True)
class SigningKey:
    """A public key, and the algorithms that a token may name with it."""

    key: Any
    algorithms: tuple[str, ...]


@dataclass(frozen=True)
class Endpoints:
    authorization: str
    token: str


class Issuer:
    """An issuer and its keys as they were fetched last."""

    def __init__(self, url: str, ca: Path | None) -> None:
        """`ca` None: the authorities that the system trusts. Raises InvalidArgument where the file holds none."""
        self.url = url
        try:
            tls = ssl.create_default_context(cafile=ca)
        except OSError as error:
            raise InvalidArgument(
                f"oidc_ca: {ca} holds no certificates ({error.strerror or error})", field="oidc_ca"
            ) from None
        self._opener = urllib.request.build_opener(urllib.request.HTTPSHandler(context=tls), _NoRedirects)
        self._published: list[Any] = []
        # Keys that tokens named and that are not known: to be fetched, being fetched, and not found by the last fetch.
        self._queue: set[str | None] = set()
        self._fetching: set[str | None] = set()
        self._absent: set[str | None] = set()
        self._wanted = asyncio.Event()
        self.keys: Mapping[str | None, SigningKey] = {}  # by their ids; another object when they change
        self.endpoints: Endpoints | None = None  # None: not known yet, or it signs nobody in
        self.problem: str | None = "its keys were not fetched yet"  # for the log alone: it may name addresses

    def key(self, key_id: str | None) -> SigningKey:
        """The key of an id; None: the only one. Raises Unauthenticated, IssuerUnavailable where it is not known yet."""
        known_key = self.keys.get(key_id)
        if known_key is not None:
            return known_key
        if self.problem is not None:
            raise IssuerUnavailable("the token cannot be checked: its issuer does not answer", field="Authorization")
        if key_id in self._absent or len(self._queue) >= _MAX_QUEUE:
            raise Unauthenticated("the token is signed with a key that its issuer does not have", field="Authorization")
        if key_id not in self._fetching:
            self._queue.add(key_id)
            self._wanted.set()
        raise IssuerUnavailable(
            "the token names a new key of its issuer, and the keys are being fetched", field="Authorization"
        )

    async def follow(self) -> None:
        rounds = Rounds("the watch over the issuer's keys", _log)
        while True:
            with rounds.round():
                await self._look()
            await asyncio.sleep(LEAST_INTERVAL_S)
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(
                    self._wanted.wait(), (REFRESH_S if self.problem is None else RETRY_S) - LEAST_INTERVAL_S
                )

    async def _look(self) -> None:
        self._wanted.clear()
        self._fetching, self._queue = self._queue, set()
        problem = await asyncio.to_thread(self._fetch)
        self._absent, self._fetching = self._fetching - self.keys.keys(), set()
        if problem != self.problem:
            self.problem = problem
            if problem is None:
                _log.info("the keys of %s are known: %d", self.url, len(self.keys))
            else:
                _log.error("tokens of %s cannot be checked: %s", self.url, problem)

    def _fetch(self) -> str | None:
        """Takes over the keys that the issuer publishes. Why it could not, if so: the ones before stay."""
        try:
            discovered = self._get(self.url.rstrip("/") + DISCOVERY_PATH)
            if discovered["issuer"] != self.url:
                return f"the issuer calls itself {discovered['issuer']!r}"
            self.endpoints = _endpoints(discovered)
            published = self._get(check_url(discovered["jwks_uri"], "jwks_uri"))["keys"]
            if published != self._published:
                keys = dict(entry for one in published if (entry := _usable(one)) is not None)
                if len(keys) == 1:
                    keys[None] = next(iter(keys.values()))
                self.keys, self._published = keys, published
        except (OSError, HTTPException, ValueError, LookupError, TypeError, RecursionError) as error:
            return f"the issuer does not answer as expected ({error})"
        return None

    def _get(self, url: str) -> Any:
        end = time.monotonic() + _ANSWER_TIMEOUT_S
        content = b""
        with self._opener.open(url, timeout=_CONNECT_TIMEOUT_S) as answer:
            while chunk := answer.read1(2**16):
                content += chunk
                if len(content) > _LARGEST_ANSWER_BYTES or time.monotonic() > end:
                    raise ValueError(f"{url} answers too slowly, or with more than {_LARGEST_ANSWER_BYTES} bytes")
        return json.loads(content)


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """Takes a redirection as the refusal that it is: it might lead to where nothing is encrypted."""

    def redirect_request(self, *_: Any) -> None:
        return None


def _endpoints(discovered: Any) -> Endpoints | None:
    """The endpoints of an issuer; None: it publishes none. Raises InvalidArgument for one that is not encrypted."""
    names = ("authorization_endpoint", "token_endpoint")
    if any(name not in discovered for name in names):
        return None
    return Endpoints(*(check_url(str(discovered[name]), name) for name in names))


def _usable(published: Any) -> tuple[str | None, SigningKey] | None:
    """Id and key of a JSON Web Key that tokens may be signed with; None: it is for something else."""
    kind = published["kty"] if published["kty"] == "RSA" else published.get("crv")
    algorithms = _SIGNATURES.get(kind, ())
    if (algorithm := published.get("alg")) is not None:
        algorithms = tuple(one for one in algorithms if one == algorithm)
    if not algorithms or published.get("use", "sig") != "sig":
        return None
    try:
        key = jwt.PyJWK(published, algorithms[0]).key
    except jwt.PyJWTError:
        return None
    if kind == "RSA" and key.key_size < _LEAST_RSA_BITS:
        return None
    return published.get("kid"), SigningKey(key, algorithms)


MAX_TOKEN_BYTES = 16_384
LEEWAY_S = 30.0  # by which clocks may differ
_MAX_VERIFIED = 4096
_LONGEST_NAME = 200
_LATEST_S = 253_402_300_000.0  # in the year 9999, the last that dates have
_TOKEN = re.compile(r"[\w-]+\.[\w-]+\.[\w-]*", flags=re.ASCII)
_REFUSALS = {  # by what PyJWT found
    jwt.ExpiredSignatureError: "the token has expired",
    jwt.ImmatureSignatureError: "the token is not valid yet",
    jwt.InvalidAudienceError: "the token is for another audience than this service",
    jwt.InvalidIssuerError: "the token is of another issuer",
    jwt.InvalidAlgorithmError: "the token names an algorithm that its key does not allow",
    jwt.InvalidSignatureError: "the signature of the token is wrong",
}


class OidcTokens:
    """An Authenticator. A token is verified once; then it is known until it expires, or the issuer's keys change."""

    is_used = True

    def __init__(
        self, issuer: Issuer, *, audience: str | None, role_claim: str, name_claim: str, roles: Mapping[str, Role]
    ) -> None:
        self.issuer, self._audience, self._role_claim = issuer, audience, role_claim
        self._name_claim, self._roles = name_claim, roles
        self._verified: dict[bytes, Principal] = {}
        self._verified_with: Mapping[str | None, SigningKey] = {}

    def authenticate(self, credential: str) -> Principal | None:
        if _TOKEN.fullmatch(credential) is None:
            return None
        if len(credential) > MAX_TOKEN_BYTES:
            raise Unauthenticated(f"the token is longer than {MAX_TOKEN_BYTES} bytes", field="Authorization")
        if self._verified_with is not self.issuer.keys:
            self._verified, self._verified_with = {}, self.issuer.keys
        digest = digest_of(credential)
        principal = self._verified.get(digest)
        if principal is None:
            principal = self._verify(credential)
            while len(self._verified) >= _MAX_VERIFIED:
                del self._verified[next(iter(self._verified))]
            self._verified[digest] = principal
        return principal

    def _verify(self, token: str) -> Principal:
        try:
            key = self.issuer.key(jwt.get_unverified_header(token).get("kid"))
            claims = jwt.decode(
                token,
                key.key,
                algorithms=key.algorithms,
                audience=self._audience,
                issuer=self.issuer.url,
                leeway=LEEWAY_S,
                options={"require": ["exp", "iss", "aud"]},
            )
            expires_at_s = min(int(claims["exp"]), _LATEST_S) + LEEWAY_S
        except jwt.MissingRequiredClaimError as error:
            raise Unauthenticated(f"the token has no claim {error.claim!r}", field="Authorization") from None
        except (jwt.PyJWTError, ValueError, TypeError, OverflowError, RecursionError) as error:
            reason = next((words for kind, words in _REFUSALS.items() if isinstance(error, kind)), None)
            raise Unauthenticated(reason or "the token cannot be read", field="Authorization") from None
        return Principal(self._name(claims), self._role(claims), "oidc", expires_at_s)

    def _name(self, claims: Mapping[str, Any]) -> str:
        name = claim_at(claims, self._name_claim)
        if not isinstance(name, str) or not name.isprintable() or not 0 < len(name) <= _LONGEST_NAME:
            raise Unauthenticated(f"the token has no claim {self._name_claim!r} with a name", field="Authorization")
        return f"oidc:{name}"

    def _role(self, claims: Mapping[str, Any]) -> Role:
        role = highest_role(claim_at(claims, self._role_claim), self._roles)
        if role is None:
            raise PermissionDenied(
                f"the token's claim {self._role_claim!r} holds nothing that gives a role here", field="Authorization"
            )
        return role

"""Tokens of an OpenID Connect issuer: verified with its keys, their claims mapped to a role."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import jwt

from ultragray_service.access.guard import digest_of
from ultragray_service.access.oidc.claims import claim_at, highest_role, parse_roles
from ultragray_service.access.oidc.issuer import Issuer, SigningKey
from ultragray_service.access.principal import Principal, Role
from ultragray_service.errors import PermissionDenied, Unauthenticated
from ultragray_service.settings import Settings

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

    def __init__(self, settings: Settings, issuer: Issuer) -> None:
        self.issuer = issuer
        self._audience = settings.oidc_audience
        self._role_claim = settings.oidc_role_claim
        self._name_claim = settings.oidc_name_claim
        self._roles = parse_roles(settings.oidc_roles)
        self._verified: dict[bytes, Principal] = {}
        self._verified_with: Mapping[str | None, SigningKey] = {}

    @classmethod
    def of(cls, settings: Settings) -> OidcTokens | None:
        """The tokens of the settings; None: they name no issuer."""
        if settings.oidc_issuer is None:
            return None
        return cls(settings, Issuer(settings.oidc_issuer, settings.oidc_ca))

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

"""Tokens of an OpenID Connect issuer, verified with the keys that a real issuer publishes over HTTP."""

from __future__ import annotations

import asyncio
import base64
import hmac
import json
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from typing import Any

import jwt
import pytest
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from jwt.algorithms import RSAAlgorithm

from ultragray.errors import InvalidArgument, UltragrayError
from ultragray_service.access import oidc as issuer_module
from ultragray_service.access.oidc import LEEWAY_S, MAX_TOKEN_BYTES, OidcTokens, claim_at, parse_roles
from ultragray_service.access.principals import Role
from ultragray_service.errors import IssuerUnavailable
from ultragray_service.settings import load_settings
from ultragray_service.wiring import oidc_tokens

from ...waiting import Deadline
from .identity_provider import IdentityProvider


@pytest.fixture
def provider() -> Iterator[IdentityProvider]:
    found = IdentityProvider()
    found.add_key("one")
    yield found
    found.close()


@asynccontextmanager
async def following(provider: IdentityProvider, **settings: str) -> AsyncIterator[OidcTokens]:
    tokens = oidc_tokens(load_settings(**{**provider.settings(), **settings}))
    assert tokens is not None
    task = asyncio.ensure_future(tokens.issuer.follow())
    try:
        await until(lambda: tokens.issuer.problem is None)
        yield tokens
    finally:
        task.cancel()


async def until(condition: Callable[[], bool]) -> None:
    end = Deadline(60)
    while not condition():
        assert not end.passed
        await asyncio.sleep(0.01)


def with_tokens(provider: IdentityProvider, check: Callable[[OidcTokens], None], **settings: str) -> None:
    async def run() -> None:
        async with following(provider, **settings) as tokens:
            check(tokens)

    asyncio.run(run())


def unsigned(header: dict[str, Any], claims: dict[str, Any], signature: bytes = b"") -> str:
    parts = (json.dumps(header).encode(), json.dumps(claims).encode(), signature)
    return ".".join(base64.urlsafe_b64encode(part).rstrip(b"=").decode() for part in parts)


def signed_with_the_public_key(provider: IdentityProvider) -> str:
    """As if the public key, which everybody knows, were the shared secret of HS256."""
    public = provider.keys["one"][1].public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    content = unsigned({"alg": "HS256", "typ": "JWT", "kid": "one"}, provider.claims())[:-1]
    signature = hmac.digest(public, content.encode(), "sha256")
    return f"{content}.{base64.urlsafe_b64encode(signature).rstrip(b'=').decode()}"


def refusal(tokens: OidcTokens, token: str) -> str:
    with pytest.raises(UltragrayError) as caught:
        tokens.authenticate(token)
    return f"{type(caught.value).__name__}: {caught.value.detail}"


@pytest.mark.parametrize("algorithm", ["RS256", "ES256", "EdDSA"])
def test_a_token_becomes_a_principal(provider: IdentityProvider, algorithm: str) -> None:
    provider.add_key("two", algorithm)

    def check(tokens: OidcTokens) -> None:
        principal = tokens.authenticate(token)
        assert principal is not None
        assert (principal.name, principal.role, principal.source) == ("oidc:alice", Role.READER, "oidc")
        assert principal.expires_at_s == jwt.decode(token, options={"verify_signature": False})["exp"] + LEEWAY_S
        assert tokens.authenticate(token) is principal, "the signature is verified once"

    token = provider.token("two")
    with_tokens(provider, check)


def test_what_is_no_token_is_left_to_other_sources(provider: IdentityProvider) -> None:
    def check(tokens: OidcTokens) -> None:
        for credential in ("", "ultragray_abcdefgh", "a.b", "a.b.c.d", "ä.b.c", "a.b.c\n", "." * 50_000):
            assert tokens.authenticate(credential) is None

    with_tokens(provider, check)


def test_tokens_that_are_refused_say_why(provider: IdentityProvider) -> None:
    now = time.time()
    foreign = rsa.generate_private_key(65537, 2048)
    algorithm = "names an algorithm that its key does not allow"
    refusals = {
        provider.token(exp=int(now - LEEWAY_S - 5)): "Unauthenticated: the token has expired",
        provider.token(nbf=int(now + LEEWAY_S + 60)): "Unauthenticated: the token is not valid yet",
        provider.token(aud="another"): "Unauthenticated: the token is for another audience than this service",
        provider.token(iss="https://evil.example"): "Unauthenticated: the token is of another issuer",
        provider.token(exp=None): "Unauthenticated: the token has no claim 'exp'",
        provider.token(aud=None): "Unauthenticated: the token has no claim 'aud'",
        provider.token(sub=None): "Unauthenticated: the token has no claim 'sub' with a name",
        provider.token(sub="a\nb"): "Unauthenticated: the token has no claim 'sub' with a name",
        unsigned({"alg": "none", "kid": "one"}, provider.claims()): algorithm,
        signed_with_the_public_key(provider): algorithm,
        jwt.encode(provider.claims(), foreign, "PS256", {"kid": "one"}): algorithm,
        jwt.encode(provider.claims(), foreign, "RS256", {"kid": "one"}): "the signature of the token is wrong",
        unsigned({"alg": "RS256", "kid": "one"}, provider.claims(), b"x"): "the signature of the token is wrong",
        provider.token(padding="x" * MAX_TOKEN_BYTES): f"the token is longer than {MAX_TOKEN_BYTES} bytes",
        unsigned({"alg": "RS256", "kid": ["one"]}, {}): "Unauthenticated: the token cannot be read",
        unsigned({"alg": "RS256", "kid": "one", "crit": ["b64"], "b64": False}, {}): "Unauthenticated: ",
        "bm90.bm90.bm90": "Unauthenticated: the token cannot be read",
        provider.token(realm_access={"roles": ["visitor"]}): "PermissionDenied: the token's claim 'realm_access.roles'",
        provider.token(realm_access=None): "PermissionDenied: ",
        provider.token(realm_access={"roles": [{}, None, 7]}): "PermissionDenied: ",
    }

    def check(tokens: OidcTokens) -> None:
        for token, expected in refusals.items():
            assert expected in refusal(tokens, token)

    with_tokens(provider, check)


def test_clocks_may_differ_a_little(provider: IdentityProvider) -> None:
    now = int(time.time())

    def check(tokens: OidcTokens) -> None:
        assert tokens.authenticate(provider.token(exp=now - 5))
        assert tokens.authenticate(provider.token(nbf=now + 5, iat=now + 5))

    with_tokens(provider, check)


def test_numbers_that_no_clock_holds_are_refused_or_bounded(provider: IdentityProvider) -> None:
    def check(tokens: OidcTokens) -> None:
        principal = tokens.authenticate(provider.token(exp=10**300))
        assert principal is not None
        assert principal.expires_at_s is not None
        assert "cannot be read" in refusal(tokens, provider.token(exp=float("inf")))
        assert "cannot be read" in refusal(tokens, provider.token(exp="soon"))
        deep = unsigned({"alg": "RS256", "kid": "one"}, {}).split(".")
        nested = base64.urlsafe_b64encode(b"[" * 6000).rstrip(b"=").decode()
        assert refusal(tokens, f"{nested}.{deep[1]}.{deep[2]}")

    with_tokens(provider, check)


def test_the_highest_role_counts_wherever_the_claim_lies(provider: IdentityProvider) -> None:
    def roles_of(claim: str, **claims: Any) -> Role:
        found: list[Role] = []

        def check(tokens: OidcTokens) -> None:
            principal = tokens.authenticate(provider.token(**claims))
            assert principal is not None
            found.append(principal.role)

        with_tokens(provider, check, oidc_role_claim=claim)
        return found[0]

    assert roles_of("groups", groups=["radiology", "research"]) is Role.OPERATOR
    assert roles_of("scope", scope="openid ultragray-admin") is Role.ADMIN
    name = "https://hospital.example/roles"
    assert roles_of(name, **{name: ["radiology"]}) is Role.READER
    assert claim_at({"a": {"b": [1]}}, "a.b") == [1]
    assert claim_at({"a": "text"}, "a.b.c") is None


def test_new_keys_are_fetched_when_a_token_names_them(
    provider: IdentityProvider, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(issuer_module, "LEAST_INTERVAL_S", 0.2)

    async def run() -> None:
        async with following(provider) as tokens:
            before = provider.token("one")
            assert tokens.authenticate(before)
            provider.add_key("two")
            provider.remove_key("one")
            assert tokens.authenticate(before), "not looked at yet"
            assert "IssuerUnavailable: the token names a new key" in refusal(tokens, provider.token("two"))
            await until(lambda: "two" in tokens.issuer.keys)
            assert tokens.authenticate(provider.token("two"))
            assert "IssuerUnavailable" in refusal(tokens, before), "the key was taken out; it may have come back"
            await until(lambda: "does not have" in refusal(tokens, before))
            fetches = provider.fetches
            for _ in range(100):
                assert "does not have" in refusal(tokens, before)
            await asyncio.sleep(0.5)
            assert provider.fetches == fetches, "keys that the issuer does not have are not asked for again and again"

    asyncio.run(run())


def test_many_unknown_keys_are_one_fetch(provider: IdentityProvider, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(issuer_module, "LEAST_INTERVAL_S", 0.5)

    async def run() -> None:
        async with following(provider) as tokens:
            fetches = provider.fetches
            for number in range(300):
                assert refusal(tokens, provider.token(headers={"kid": f"made up {number}"}))
            await until(lambda: provider.fetches > fetches)
            assert provider.fetches == fetches + 1

    asyncio.run(run())


def test_keys_that_sign_no_tokens_are_passed_over(provider: IdentityProvider) -> None:
    provider.add_key("encryption", use="enc")
    provider.add_key("other", alg="RSA-OAEP")
    small = RSAAlgorithm.to_jwk(rsa.generate_private_key(65537, 1024).public_key(), as_dict=True)
    provider.published += [
        small | {"kid": "small"},
        {"kty": "oct", "k": "c2VjcmV0", "kid": "shared", "alg": "HS256"},
        {"kty": "EC", "crv": "P-256", "x": "AA", "y": "AA", "kid": "broken"},
        {"kty": "new", "kid": "new"},
    ]
    with_tokens(provider, lambda tokens: _keys_are(tokens, {"one", None}))


def _keys_are(tokens: OidcTokens, expected: set[str | None]) -> None:
    assert tokens.issuer.keys.keys() == expected


def test_a_token_without_the_id_of_a_key_is_of_the_only_one(provider: IdentityProvider) -> None:
    token = jwt.encode(provider.claims(), provider.keys["one"][1], "RS256")
    with_tokens(provider, lambda tokens: _principal_of(tokens, token))
    provider.add_key("two")
    with_tokens(provider, lambda tokens: _refused(tokens, token))


def _principal_of(tokens: OidcTokens, token: str) -> None:
    assert tokens.authenticate(token)


def _refused(tokens: OidcTokens, token: str) -> None:
    assert refusal(tokens, token)


def test_an_issuer_that_is_away_leaves_the_keys_that_are_known(
    provider: IdentityProvider, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(issuer_module, "LEAST_INTERVAL_S", 0.05)
    monkeypatch.setattr(issuer_module, "REFRESH_S", 0.1)
    monkeypatch.setattr(issuer_module, "RETRY_S", 0.1)

    async def run() -> None:
        async with following(provider) as tokens:
            provider.up = False
            await until(lambda: tokens.issuer.problem is not None)
            assert tokens.authenticate(provider.token())
            provider.add_key("two")
            with pytest.raises(IssuerUnavailable, match="its issuer does not answer"):
                tokens.authenticate(provider.token("two"))
            provider.up = True
            await until(lambda: tokens.issuer.problem is None)
            assert tokens.authenticate(provider.token("two"))

    asyncio.run(run())


def test_an_issuer_of_another_name_is_not_believed(provider: IdentityProvider) -> None:
    async def run() -> None:
        tokens = oidc_tokens(load_settings(**{**provider.settings(), "oidc_issuer": provider.url + "/"}))
        assert tokens is not None
        task = asyncio.ensure_future(tokens.issuer.follow())
        await until(lambda: "calls itself" in str(tokens.issuer.problem))
        assert not tokens.issuer.keys
        task.cancel()

    asyncio.run(run())


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"oidc_issuer": "http://login.example"}, "ULTRAGRAY_OIDC_ISSUER.* must be a URL that begins with https://"),
        ({"oidc_issuer": "login.example"}, "ULTRAGRAY_OIDC_ISSUER"),
        ({"oidc_audience": None}, "ULTRAGRAY_OIDC_AUDIENCE.* must be given"),
        ({"oidc_roles": None}, "ULTRAGRAY_OIDC_ROLES.* must be given"),
        ({"oidc_roles": "radiology"}, "ULTRAGRAY_OIDC_ROLES.* must be of the form VALUE=ROLE"),
        ({"oidc_roles": "radiology=chief"}, "reader, operator, admin, got 'radiology=chief'"),
    ],
)
def test_settings_that_cannot_work(changed: dict[str, str | None], expected: str) -> None:
    given = {"oidc_issuer": "https://login.example", "oidc_audience": "ultragray", "oidc_roles": "a=admin", **changed}
    with pytest.raises(InvalidArgument, match=expected):
        load_settings(**{name: value for name, value in given.items() if value is not None})


def test_roles_are_parsed() -> None:
    assert parse_roles(("a=admin", "CN=Radiology=reader")) == {"a": Role.ADMIN, "CN=Radiology": Role.READER}

"""Tokens of an OpenID Connect issuer: verified with the keys that it publishes, and at the doors beside API keys."""

import asyncio
import base64
import hmac
import json
import threading
import time
from contextlib import asynccontextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import httpx
import jwt
import pytest
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from jwt.algorithms import ECAlgorithm, OKPAlgorithm, RSAAlgorithm

from ultragray.errors import InvalidArgument, UltragrayError
from ultragray_client import Client
from ultragray_service.access import oidc as issuer_module
from ultragray_service.access.oidc import LEEWAY_S, MAX_TOKEN_BYTES, claim_at, parse_roles
from ultragray_service.access.principals import Role
from ultragray_service.errors import IssuerUnavailable
from ultragray_service.settings import load_settings
from ultragray_service.wiring import oidc_tokens

from ...waiting import Deadline, wait_until

AUDIENCE = "ultragray"
_KINDS = {
    "RS256": (lambda: rsa.generate_private_key(65537, 2048), RSAAlgorithm),
    "ES256": (lambda: ec.generate_private_key(ec.SECP256R1()), ECAlgorithm),
    "EdDSA": (ed25519.Ed25519PrivateKey.generate, OKPAlgorithm),
}


class IdentityProvider:
    """Answers while it is `up`; counts how often its keys were asked for."""

    def __init__(self):
        self.up = True
        self.fetches = 0
        self.endpoints = {}  # of the sign-in, as it publishes them
        self.published = []
        self.keys = {}
        provider = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                provider._answer(self)

            def log_message(self, *_):
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_port}/realms/hospital"
        self._thread = threading.Thread(target=self._server.serve_forever)
        self._thread.start()

    def close(self):
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def add_key(self, key_id, algorithm="RS256", **published):
        """A new key; what is published of it."""
        make, kind = _KINDS[algorithm]
        private = make()
        public = kind.to_jwk(private.public_key(), as_dict=True) | {"kid": key_id, "use": "sig", "alg": algorithm}
        self.keys[key_id] = algorithm, private
        self.published.append(public | published)
        return self.published[-1]

    def remove_key(self, key_id):
        self.published = [one for one in self.published if one["kid"] != key_id]

    def settings(self):
        """Settings of a service that takes its tokens."""
        return {
            "oidc_issuer": self.url,
            "oidc_audience": AUDIENCE,
            "oidc_role_claim": "realm_access.roles",
            "oidc_roles": "ultragray-admin=admin,radiology=reader,research=operator",
        }

    def claims(self, **changed):
        """Claims of a token that is good for an hour; `name=None` leaves one out."""
        now = int(time.time())
        claims = {
            "iss": self.url,
            "aud": AUDIENCE,
            "sub": "alice",
            "iat": now,
            "exp": now + 3600,
            "realm_access": {"roles": ["radiology", "offline_access"]},
        } | changed
        return {name: value for name, value in claims.items() if value is not None}

    def token(self, key_id="one", *, headers=None, **changed):
        """A token that the key signed."""
        algorithm, private = self.keys[key_id]
        return jwt.encode(self.claims(**changed), private, algorithm, headers={"kid": key_id} | (headers or {}))

    def _answer(self, request):
        if not self.up:
            request.send_error(503)
            return
        if request.path.endswith("/.well-known/openid-configuration"):
            document = {"issuer": self.url, "jwks_uri": f"{self.url}/certs", **self.endpoints}
        else:
            self.fetches += 1
            document = {"keys": self.published}
        content = json.dumps(document).encode()
        request.send_response(200)
        request.send_header("Content-Length", str(len(content)))
        request.end_headers()
        request.wfile.write(content)


@pytest.fixture
def provider():
    found = IdentityProvider()
    found.add_key("one")
    yield found
    found.close()


@asynccontextmanager
async def following(provider, **settings):
    tokens = oidc_tokens(load_settings(**{**provider.settings(), **settings}))
    task = asyncio.ensure_future(tokens.issuer.follow())
    try:
        await until(lambda: tokens.issuer.problem is None)
        yield tokens
    finally:
        task.cancel()


async def until(condition):
    end = Deadline(60)
    while not condition():
        assert not end.passed
        await asyncio.sleep(0.01)


def unsigned(header, claims, signature=b""):
    parts = (json.dumps(header).encode(), json.dumps(claims).encode(), signature)
    return ".".join(base64.urlsafe_b64encode(part).rstrip(b"=").decode() for part in parts)


def signed_with_the_public_key(provider):
    """As if the public key, which everybody knows, were the shared secret of HS256."""
    public = provider.keys["one"][1].public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    content = unsigned({"alg": "HS256", "typ": "JWT", "kid": "one"}, provider.claims())[:-1]
    signature = hmac.digest(public, content.encode(), "sha256")
    return f"{content}.{base64.urlsafe_b64encode(signature).rstrip(b'=').decode()}"


def refusal(tokens, token):
    with pytest.raises(UltragrayError) as caught:
        tokens.authenticate(token)
    return f"{type(caught.value).__name__}: {caught.value.detail}"


@pytest.mark.parametrize("algorithm", ["RS256", "ES256", "EdDSA"])
async def test_a_token_becomes_a_principal(provider, algorithm):
    provider.add_key("two", algorithm)
    token = provider.token("two")
    async with following(provider) as tokens:
        principal = tokens.authenticate(token)
        assert (principal.name, principal.role, principal.source) == ("oidc:alice", Role.READER, "oidc")
        assert principal.expires_at_s == jwt.decode(token, options={"verify_signature": False})["exp"] + LEEWAY_S
        assert tokens.authenticate(token) is principal, "the signature is verified once"


async def test_what_is_no_token_is_left_to_other_sources(provider):
    async with following(provider) as tokens:
        for credential in ("", "ultragray_abcdefgh", "a.b", "a.b.c.d", "ä.b.c", "a.b.c\n", "." * 50_000):
            assert tokens.authenticate(credential) is None


async def test_tokens_that_are_refused_say_why(provider):
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
    async with following(provider) as tokens:
        for token, expected in refusals.items():
            assert expected in refusal(tokens, token)


async def test_clocks_may_differ_a_little(provider):
    now = int(time.time())
    async with following(provider) as tokens:
        assert tokens.authenticate(provider.token(exp=now - 5))
        assert tokens.authenticate(provider.token(nbf=now + 5, iat=now + 5))


async def test_numbers_that_no_clock_holds_are_refused_or_bounded(provider):
    async with following(provider) as tokens:
        principal = tokens.authenticate(provider.token(exp=10**300))
        assert principal.expires_at_s is not None
        assert "cannot be read" in refusal(tokens, provider.token(exp=float("inf")))
        assert "cannot be read" in refusal(tokens, provider.token(exp="soon"))
        deep = unsigned({"alg": "RS256", "kid": "one"}, {}).split(".")
        nested = base64.urlsafe_b64encode(b"[" * 6000).rstrip(b"=").decode()
        assert refusal(tokens, f"{nested}.{deep[1]}.{deep[2]}")


async def test_the_highest_role_counts_wherever_the_claim_lies(provider):
    async def role_by(claim, value):
        async with following(provider, oidc_role_claim=claim) as tokens:
            return tokens.authenticate(provider.token(**{claim: value})).role

    assert await role_by("groups", ["radiology", "research"]) is Role.OPERATOR
    assert await role_by("scope", "openid ultragray-admin") is Role.ADMIN
    assert await role_by("https://hospital.example/roles", ["radiology"]) is Role.READER
    assert claim_at({"a": {"b": [1]}}, "a.b") == [1]
    assert claim_at({"a": "text"}, "a.b.c") is None


async def test_new_keys_are_fetched_when_a_token_names_them(provider, monkeypatch):
    monkeypatch.setattr(issuer_module, "LEAST_INTERVAL_S", 0.2)
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
        await asyncio.sleep(0.3)
        assert provider.fetches == fetches, "keys that the issuer does not have are not asked for again and again"


async def test_many_unknown_keys_are_one_fetch(provider, monkeypatch):
    monkeypatch.setattr(issuer_module, "LEAST_INTERVAL_S", 0.5)
    async with following(provider) as tokens:
        fetches = provider.fetches
        for number in range(300):
            assert refusal(tokens, provider.token(headers={"kid": f"made up {number}"}))
        await until(lambda: provider.fetches > fetches)
        assert provider.fetches == fetches + 1


async def test_keys_that_sign_no_tokens_are_passed_over(provider):
    provider.add_key("encryption", use="enc")
    provider.add_key("other", alg="RSA-OAEP")
    small = RSAAlgorithm.to_jwk(rsa.generate_private_key(65537, 1024).public_key(), as_dict=True)
    provider.published += [
        small | {"kid": "small"},
        {"kty": "oct", "k": "c2VjcmV0", "kid": "shared", "alg": "HS256"},
        {"kty": "EC", "crv": "P-256", "x": "AA", "y": "AA", "kid": "broken"},
        {"kty": "new", "kid": "new"},
    ]
    async with following(provider) as tokens:
        assert set(tokens.issuer.keys) == {"one", None}


async def test_a_token_without_the_id_of_a_key_is_of_the_only_one(provider):
    token = jwt.encode(provider.claims(), provider.keys["one"][1], "RS256")
    async with following(provider) as tokens:
        assert tokens.authenticate(token)
    provider.add_key("two")
    async with following(provider) as tokens:
        assert refusal(tokens, token)


async def test_an_issuer_that_is_away_leaves_the_keys_that_are_known(provider, monkeypatch):
    monkeypatch.setattr(issuer_module, "LEAST_INTERVAL_S", 0.05)
    monkeypatch.setattr(issuer_module, "REFRESH_S", 0.1)
    monkeypatch.setattr(issuer_module, "RETRY_S", 0.1)
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


@pytest.mark.parametrize(
    ("end", "token_endpoint", "problem"),
    [
        ("/", "https://hospital.example", "calls itself"),
        ("", "http://hospital.example", "token_endpoint must be a URL"),
    ],
)
async def test_an_issuer_of_another_name_or_without_encryption_is_not_believed(provider, end, token_endpoint, problem):
    provider.endpoints = {"authorization_endpoint": f"{provider.url}/auth", "token_endpoint": token_endpoint}
    tokens = oidc_tokens(load_settings(**{**provider.settings(), "oidc_issuer": provider.url + end}))
    task = asyncio.ensure_future(tokens.issuer.follow())
    await until(lambda: problem in str(tokens.issuer.problem))
    assert (tokens.issuer.keys, tokens.issuer.endpoints) == ({}, None)
    task.cancel()


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
def test_settings_that_cannot_work(changed, expected):
    given = {"oidc_issuer": "https://login.example", "oidc_audience": "ultragray", "oidc_roles": "a=admin", **changed}
    with pytest.raises(InvalidArgument, match=expected):
        load_settings(**{name: value for name, value in given.items() if value is not None})


def test_roles_are_parsed():
    assert parse_roles(("a=admin", "CN=Radiology=reader")) == {"a": Role.ADMIN, "CN=Radiology": Role.READER}


KEY = "0123456789abcdef-environment"


@pytest.fixture(scope="module")
def issuer():
    found = IdentityProvider()
    found.add_key("one")
    yield found
    found.close()


@pytest.fixture(scope="module")
def guarded(start_service, issuer):
    service = start_service(**issuer.settings(), api_keys=KEY)
    wait_until(lambda: identity_provider(service) == "available")
    return service


def identity_provider(service):
    return httpx.get(f"{service.http}/v1/health/ready", timeout=300).json()["identity_provider"]


def ask(service, credential):
    return httpx.get(f"{service.http}/v1/scenes", headers={"Authorization": f"Bearer {credential}"}, timeout=300)


def test_a_token_opens_both_doors(guarded, issuer):
    assert ask(guarded, issuer.token()).status_code == 200
    given = iter([issuer.token(), issuer.token(exp=1)])
    with Client(guarded.grpc, api_key=lambda: next(given), timeout_s=300.0) as client:
        assert client.scenes.list()
        with pytest.raises(Exception, match="UNAUTHENTICATED: the token has expired"):
            client.scenes.list()


def test_the_page_is_told_where_people_sign_in(start_service):
    issuer = IdentityProvider()
    issuer.add_key("one")
    issuer.endpoints = {
        "authorization_endpoint": f"{issuer.url}/auth",
        "token_endpoint": "https://tokens.hospital.example:8443/token",
    }
    try:
        service = start_service(**issuer.settings(), oidc_client_id="console", oidc_scope="openid roles")
        wait_until(lambda: identity_provider(service) == "available")
        assert httpx.get(f"{service.http}/v1/sign-in", timeout=300).json() == {
            "provider": {**issuer.endpoints, "client_id": "console", "scope": "openid roles"}
        }
        policy = httpx.get(service.http, timeout=300).headers["content-security-policy"]
        assert policy.endswith(" https://tokens.hospital.example:8443")
    finally:
        issuer.close()


def test_without_a_client_id_people_sign_in_with_keys(guarded):
    assert httpx.get(f"{guarded.http}/v1/sign-in", timeout=300).json() == {"provider": None}
    assert "hospital" not in httpx.get(guarded.http, timeout=300).headers["content-security-policy"]

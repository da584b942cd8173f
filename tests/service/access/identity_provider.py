"""An OpenID Connect issuer on this machine: discovery, keys, and tokens that it signs."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import jwt
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
from jwt.algorithms import ECAlgorithm, OKPAlgorithm, RSAAlgorithm

AUDIENCE = "ultragray"
_KINDS: dict[str, tuple[Callable[[], Any], Any]] = {
    "RS256": (lambda: rsa.generate_private_key(65537, 2048), RSAAlgorithm),
    "ES256": (lambda: ec.generate_private_key(ec.SECP256R1()), ECAlgorithm),
    "EdDSA": (ed25519.Ed25519PrivateKey.generate, OKPAlgorithm),
}


class IdentityProvider:
    """Answers while it is `up`; counts how often its keys were asked for."""

    def __init__(self) -> None:
        self.up = True
        self.fetches = 0
        self.endpoints: dict[str, str] = {}  # of the sign-in, as it publishes them
        self.published: list[dict[str, Any]] = []
        self.keys: dict[str, tuple[str, Any]] = {}
        provider = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                provider._answer(self)

            def log_message(self, *_: object) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_port}/realms/hospital"
        self._thread = threading.Thread(target=self._server.serve_forever)
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def add_key(self, key_id: str, algorithm: str = "RS256", **published: Any) -> dict[str, Any]:
        """A new key; what is published of it."""
        make, kind = _KINDS[algorithm]
        private = make()
        public = kind.to_jwk(private.public_key(), as_dict=True) | {"kid": key_id, "use": "sig", "alg": algorithm}
        self.keys[key_id] = algorithm, private
        self.published.append(public | published)
        return self.published[-1]

    def remove_key(self, key_id: str) -> None:
        self.published = [one for one in self.published if one["kid"] != key_id]

    def settings(self) -> dict[str, str]:
        """Settings of a service that takes its tokens."""
        return {
            "oidc_issuer": self.url,
            "oidc_audience": AUDIENCE,
            "oidc_role_claim": "realm_access.roles",
            "oidc_roles": "ultragray-admin=admin,radiology=reader,research=operator",
        }

    def claims(self, **changed: Any) -> dict[str, Any]:
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

    def token(self, key_id: str = "one", *, headers: dict[str, Any] | None = None, **changed: Any) -> str:
        """A token that the key signed."""
        algorithm, private = self.keys[key_id]
        return jwt.encode(self.claims(**changed), private, algorithm, headers={"kid": key_id} | (headers or {}))

    def _answer(self, request: BaseHTTPRequestHandler) -> None:
        if not self.up:
            request.send_error(503)
            return
        if request.path.endswith("/.well-known/openid-configuration"):
            document: Any = {"issuer": self.url, "jwks_uri": f"{self.url}/certs", **self.endpoints}
        else:
            self.fetches += 1
            document = {"keys": self.published}
        content = json.dumps(document).encode()
        request.send_response(200)
        request.send_header("Content-Length", str(len(content)))
        request.end_headers()
        request.wfile.write(content)

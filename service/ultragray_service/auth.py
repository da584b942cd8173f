"""API keys: the same rule for both front doors."""

from __future__ import annotations

import base64
import binascii
import hmac
from collections.abc import Iterable, Sequence

from .errors import Unauthenticated

STREAM_PROTOCOL = "ultragray.v1"  # WebSocket subprotocol
_KEY_PROTOCOL = "ultragray.key."


def key_of_subprotocols(offered: Iterable[str]) -> str | None:
    """The key that a page offers as the subprotocol `ultragray.key.` + base64url of the key.

    Browsers let a page set no header of a WebSocket but this one.
    """
    for name in offered:
        if name.startswith(_KEY_PROTOCOL):
            coded = name[len(_KEY_PROTOCOL) :]
            try:
                return base64.urlsafe_b64decode(coded + "=" * (-len(coded) % 4)).decode()
            except (binascii.Error, UnicodeDecodeError):
                return None
    return None


class KeyGuard:
    """Knows the keys. Without keys everyone may pass."""

    def __init__(self, keys: Sequence[str]) -> None:
        self._keys = [key.encode() for key in keys]

    def check(self, authorization: str | None, x_api_key: str | None) -> None:
        """Raises Unauthenticated unless `Authorization: Bearer KEY` or `X-API-Key: KEY` has a known key."""
        if not self._keys:
            return
        offered = x_api_key
        if offered is None and authorization is not None:
            scheme, _, token = authorization.partition(" ")
            offered = token.strip() if scheme.lower() == "bearer" else None
        if offered is None:
            raise Unauthenticated(
                "an API key is required: send Authorization: Bearer KEY, or X-API-Key: KEY",
                field="Authorization",
            )
        candidate = offered.encode()
        # Every key is compared, so that the time tells nothing about which one came close.
        if not sum([hmac.compare_digest(candidate, key) for key in self._keys]):
            raise Unauthenticated("the API key is not known", field="Authorization")

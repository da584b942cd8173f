"""Where clients put their key or token."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Iterable

STREAM_PROTOCOL = "ultragray.v1"  # WebSocket subprotocol
_KEY_PROTOCOL = "ultragray.key."


def offered_credential(authorization: str | None, x_api_key: str | None) -> str | None:
    """The credential of `X-API-Key: KEY` or `Authorization: Bearer KEY`; None where there is none."""
    if x_api_key is not None or authorization is None:
        return x_api_key
    scheme, _, token = authorization.partition(" ")
    return token.strip() if scheme.lower() == "bearer" else None


def credential_of_subprotocols(offered: Iterable[str]) -> str | None:
    """The credential that a page offers as the subprotocol `ultragray.key.` + base64url of it.

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

"""Where clients put their key or token."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence

from ultragray_service.errors import Unauthenticated

STREAM_PROTOCOL = "ultragray.v1"  # WebSocket subprotocol
_KEY_PROTOCOL = "ultragray.key."


def offered_credential(authorizations: Sequence[str], api_keys: Sequence[str]) -> str | None:
    """The credential of `X-API-Key: KEY`, else of `Authorization: Bearer KEY`; None where there is none.

    Raises Unauthenticated for several of one kind: of which the service would take one, and a proxy another.
    """
    for field, values in (("X-API-Key", api_keys), ("Authorization", authorizations)):
        if len(values) > 1:
            raise Unauthenticated(f"{field} must be sent once, got {len(values)}", field=field)
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

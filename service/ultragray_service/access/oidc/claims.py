"""What an OpenID Connect issuer says of somebody, and the role that it gives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import urlsplit

from ultragray.errors import InvalidArgument
from ultragray_service.access.addresses import is_loopback
from ultragray_service.access.principal import Role


def check_url(url: str, field: str) -> str:
    """Raises InvalidArgument unless encrypted, or of this machine."""
    parts = urlsplit(url)
    if not parts.hostname or (parts.scheme != "https" and not (parts.scheme == "http" and is_loopback(parts.hostname))):
        raise InvalidArgument(f"{field} must be a URL that begins with https://, got {url!r}", field=field)
    return url


def parse_roles(mapping: Sequence[str]) -> dict[str, Role]:
    """Roles by the values of a claim, from `VALUE=ROLE`. Raises InvalidArgument."""
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
    found: Any = claims
    for part in path.split("."):
        found = found.get(part) if isinstance(found, dict) else None
    return found


def highest_role(values: Any, roles: Mapping[str, Role]) -> Role | None:
    """The highest role that a claim gives: a list of values, or a text of several with spaces between them."""
    listed = values.split() if isinstance(values, str) else values if isinstance(values, list) else []
    given = [roles[value] for value in listed if isinstance(value, str) and value in roles]
    return max(given, key=list(Role).index, default=None)

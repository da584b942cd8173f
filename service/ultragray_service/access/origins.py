"""Which pages may reach a service that asks for no key, and which WebSockets any service opens.

A browser lets every page send requests to this machine. Two headers that no page can change tell them apart: `Origin`,
the site of the page, and `Host`, the name that it used for this machine, which is a foreign one where somebody's DNS
was made to point here (rebinding).
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Sequence
from urllib.parse import urlsplit

from ultragray_service.access.principals import is_loopback
from ultragray_service.errors import HostRefused, OriginRefused

_ANY = "*"
_HOST = re.compile(r"(\[(?P<address>[0-9A-Fa-f:.]+)\]|(?P<name>[A-Za-z0-9._-]+))(:[0-9]{0,5})?", re.ASCII)


class Origins:
    """Checks the headers of requests that browsers sent; those of other programs have no Origin."""

    def __init__(self, host: str, *, names: Sequence[str], pages: Sequence[str]) -> None:
        """`host`: that the service listens at; `names`: others that it is known as; `pages`: origins of other sites."""
        self._pages = frozenset(pages)
        self._hosts = frozenset(name.lower() for name in (host, *names))
        # An address is not a name that anybody could point here. It is checked all the same where only this machine is
        # served, which no other address can be the right one of.
        self._any_address = not is_loopback(host)

    def require_host(self, host: str | None) -> None:
        if host is not None and not self._allows(host):
            raise HostRefused(
                f"this service is not known as {host[:128]!r}: allow the name with ULTRAGRAY_ALLOWED_HOSTS, or give the"
                " service API keys",
                field="Host",
            )

    def require_page(
        self, *, origin: str | None, host: str | None, fetch_site: str | None = None, is_link: bool = False
    ) -> None:
        """Raises OriginRefused for a request of another site's page; `is_link`: whether it follows a link to a page."""
        if origin is not None:
            self._require_origin(origin, host)
        elif fetch_site == "cross-site" and not is_link:
            raise OriginRefused("pages of other sites may not load this; a link to it may be followed", field="Origin")

    def _require_origin(self, origin: str, host: str | None) -> None:
        if origin in self._pages or _ANY in self._pages:
            return
        try:
            parts = urlsplit(origin)
        except ValueError:
            parts = urlsplit("")
        if parts.scheme not in ("http", "https") or host is None or parts.netloc.lower() != host.lower():
            raise OriginRefused(
                f"pages of {origin[:128]} may not use this service; allow them with ULTRAGRAY_CORS_ORIGINS",
                field="Origin",
            )

    def _allows(self, host: str) -> bool:
        if _ANY in self._hosts:
            return True
        match = _HOST.fullmatch(host)
        if match is None:
            return False
        name = (match["address"] or match["name"]).lower()
        if name in self._hosts or is_loopback(name):
            return True
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return self._any_address

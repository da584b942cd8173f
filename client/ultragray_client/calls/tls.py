"""Encrypted channels: the certificates of both sides, and a warning where a key would travel in the open."""

from __future__ import annotations

import ipaddress
import re
import ssl
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import grpc

from ..errors import InvalidArgument
from .connection import CHANNEL_OPTIONS

_URL = re.compile(r"(?:https?|grpcs?)://")
_TARGET = re.compile(r"(?:dns:(?://[^/]*/)?|ipv[46]:)?(\[[^]]*\]|[^:]*)")  # of gRPC: the host
_LOCAL_SCHEMES = ("unix:", "unix-abstract:")


@dataclass(frozen=True, kw_only=True)
class Tls:
    """A connection over TLS, by files in PEM format, which are read when the client is made.

    `Tls()` trusts the authorities that the system trusts. The hospital's own is given as `root_certificates`, and for a
    service that asks for the certificates of its clients (mutual TLS) `certificate` with its `key`, not encrypted.
    `server_name` is a name of the service's certificate, where it is reached by another one.
    """

    root_certificates: str | Path | None = None
    certificate: str | Path | None = None
    key: str | Path | None = None
    server_name: str | None = None

    def credentials(self) -> grpc.ChannelCredentials:
        """Credentials of a channel. Raises InvalidArgument for a file that cannot be used."""
        if (self.certificate is None) is not (self.key is None):
            raise InvalidArgument("tls.certificate and tls.key must be given together", field="tls")
        context = ssl.create_default_context()
        if self.root_certificates is not None:
            with _blamed("tls.root_certificates", self.root_certificates):
                context.load_verify_locations(self.root_certificates)
                roots = Path(self.root_certificates).read_bytes()
        else:  # where the system has none, grpc falls back to its own
            roots = "".join(map(ssl.DER_cert_to_PEM_cert, context.get_ca_certs(binary_form=True))).encode()
        if self.certificate is None or self.key is None:
            return grpc.ssl_channel_credentials(roots or None)
        with _blamed("tls.certificate", f"{self.certificate} with the key {self.key}"):
            context.load_cert_chain(self.certificate, self.key, password="")
            pair = Path(self.key).read_bytes(), Path(self.certificate).read_bytes()
        return grpc.ssl_channel_credentials(roots or None, *pair)

    def options(self) -> tuple[tuple[str, str | int], ...]:
        """Options of a channel."""
        if self.server_name is None:
            return CHANNEL_OPTIONS
        return (*CHANNEL_OPTIONS, ("grpc.ssl_target_name_override", self.server_name))


@contextmanager
def _blamed(field: str, what: object) -> Iterator[None]:
    try:
        yield
    except ssl.SSLError as error:
        raise InvalidArgument(f"{field}: {what} cannot be used ({error.reason or error})", field=field) from None
    except OSError as error:
        raise InvalidArgument(f"{field}: {what} cannot be read ({error.strerror})", field=field) from None


def check_address(address: str) -> str:
    """Raises InvalidArgument for a URL: gRPC has an address of its own."""
    if _URL.match(address):
        raise InvalidArgument(
            f"address must be HOST:PORT of the service's gRPC, got {address!r}; for TLS give tls=Tls(...)",
            field="address",
        )
    return address


def warn_of_open_key(address: str) -> None:
    """Warns, once for each place that makes such a client, that others on the way can read its key."""
    if not _is_local(address):
        warnings.warn(
            f"the API key travels unencrypted to {address}, and whoever is on the way can read it: give tls=Tls(...)",
            UserWarning,
            stacklevel=4,  # where the client is made
        )


def _is_local(address: str) -> bool:
    if address.startswith(_LOCAL_SCHEMES):
        return True
    found = _TARGET.match(address)
    host = "" if found is None else found[1].strip("[]")
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False

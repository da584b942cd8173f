"""TLS of the commands that ask a running service over HTTP."""

from __future__ import annotations

import http.client
import ipaddress
import ssl
from pathlib import Path
from urllib.parse import urlsplit

from ultragray.errors import InvalidArgument


def client_context(ca: Path | None, certificate: Path | None, key: Path | None) -> ssl.SSLContext:
    """The certificates of a client. `ca` None: the authorities that the system trusts.

    Raises InvalidArgument for a file that cannot be used, and for a certificate without its key.
    """
    if (certificate is None) is not (key is None):
        raise InvalidArgument("--client-certificate and --client-key must be given together", field="client_key")
    try:
        context = ssl.create_default_context(cafile=ca)
    except OSError as error:
        raise InvalidArgument(f"--ca: {ca} holds no certificates ({_words(error)})", field="ca") from None
    if certificate is not None:
        try:
            context.load_cert_chain(certificate, key, password="")
        except OSError as error:
            raise InvalidArgument(
                f"--client-certificate: {certificate} and {key} are no certificate and its key ({_words(error)})",
                field="client_certificate",
            ) from None
    return context


def tls_problem(server: str, error: object) -> str | None:
    """The words for a connection that TLS prevented; None: for another reason."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return (
            f"{server} shows a certificate that is not to be trusted ({error.verify_message}): name its authority with "
            "--ca, and the service by a name of its certificate"
        )
    if isinstance(error, ssl.SSLError) and error.reason == "WRONG_VERSION_NUMBER":
        return f"{server} does not speak TLS: name it with http://"
    if isinstance(error, ssl.SSLError) and "ALERT" in (error.reason or ""):
        return f"{server} refuses the client's certificate, or its absence ({_words(error)}): see --client-certificate"
    return None


def cut_off_hint(server: str, error: object) -> str:
    """What may be behind a connection that a service cut off: it says no more where it misses TLS or a certificate."""
    if not isinstance(error, (http.client.BadStatusLine, ConnectionResetError)):
        return ""
    if server.startswith("https://"):
        return "; if it asks for a client's certificate, see --client-certificate"
    return "; if it speaks TLS, name it with https://"


def exposes_key(server: str) -> bool:
    """Whether others on the way to the URL can read a key that is sent there."""
    parts = urlsplit(server)
    if parts.scheme == "https" or parts.hostname == "localhost":
        return False
    try:
        return not ipaddress.ip_address(parts.hostname or "").is_loopback
    except ValueError:
        return True


def _words(error: OSError) -> str:
    return (error.reason if isinstance(error, ssl.SSLError) else error.strerror) or str(error)

"""A server's certificate, its key, and the authorities of its clients, checked as a whole before any door uses them."""

from __future__ import annotations

import asyncio
import logging
import ssl
import time
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat, load_pem_private_key
from cryptography.x509.oid import NameOID

from ultragray_service.settings import Settings
from ultragray_workers.errors import StartupFailed
from ultragray_workers.rounds import Rounds

HANDSHAKE_TIMEOUT_S = 10.0  # of a client that connects and then says nothing, or not enough
_LARGEST_FILE_BYTES = 2**20


@dataclass(frozen=True)
class CertificateFiles:
    """The PEM files of the settings. `client_ca` None: clients need no certificate."""

    certificate: Path
    key: Path
    client_ca: Path | None

    def read(self) -> CertificateBytes:
        return CertificateBytes(
            _read(self.certificate, "tls_certificate"),
            _read(self.key, "tls_key"),
            None if self.client_ca is None else _read(self.client_ca, "tls_client_ca"),
        )

    def load(self, data: CertificateBytes) -> Certificates:
        try:
            return self._load(data)
        except (UnsupportedAlgorithm, x509.DuplicateExtension, ValueError) as error:
            raise _unusable("tls_certificate", f"{self.certificate} and {self.key}: {error}") from None
        except OSError as error:  # a file that went after it was read
            raise _unusable("tls_certificate", f"{self.certificate} and {self.key}: {error.strerror}") from None

    def _load(self, data: CertificateBytes) -> Certificates:
        chain = self._chain(data.chain)
        own = chain[0]
        if self._private_key(data.key).public_key().public_bytes(
            Encoding.DER, PublicFormat.SubjectPublicKeyInfo
        ) != own.public_key().public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo):
            raise _unusable("tls_key", f"{self.key} is not the key of the certificate in {self.certificate}")
        now = datetime.now(timezone.utc)
        if now < own.not_valid_before_utc:
            raise _unusable("tls_certificate", f"{self.certificate} is not valid before {own.not_valid_before_utc}")
        if now > own.not_valid_after_utc:
            raise _unusable("tls_certificate", f"{self.certificate} expired at {own.not_valid_after_utc}")
        return Certificates(data, _names(own), own.not_valid_before_utc, own.not_valid_after_utc, self._context(data))

    def _chain(self, content: bytes) -> list[x509.Certificate]:
        try:
            return x509.load_pem_x509_certificates(content)
        except ValueError:
            raise _unusable("tls_certificate", f"{self.certificate} holds no certificate in PEM format") from None

    def _private_key(self, content: bytes) -> PrivateKeyTypes:
        try:
            return load_pem_private_key(content, password=None)
        except TypeError:  # cryptography's answer to a missing password
            raise _unusable(
                "tls_key", f"{self.key} is encrypted; decrypt it: openssl pkey -in ENCRYPTED -out DECRYPTED"
            ) from None
        except ValueError:
            raise _unusable("tls_key", f"{self.key} holds no private key in PEM format") from None

    def _context(self, data: CertificateBytes) -> ssl.SSLContext:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        context.set_alpn_protocols(["http/1.1"])
        try:
            context.load_cert_chain(self.certificate, self.key, password="")
        except ssl.SSLError as error:
            raise _unusable("tls_certificate", f"OpenSSL refuses {self.certificate}: {error.reason or error}") from None
        if data.client_authorities is not None:
            try:
                context.load_verify_locations(cadata=data.client_authorities.decode("ascii"))
            except (ssl.SSLError, ValueError):
                raise _unusable("tls_client_ca", f"{self.client_ca} holds no certificate in PEM format") from None
            context.verify_mode = ssl.CERT_REQUIRED
        if self.read() != data:  # OpenSSL takes files, not bytes
            raise _unusable("tls_certificate", f"{self.certificate} changed while it was read")
        return context


@dataclass(frozen=True)
class CertificateBytes:
    chain: bytes
    key: bytes = field(repr=False)
    client_authorities: bytes | None


@dataclass(frozen=True)
class Certificates:
    content: CertificateBytes
    names: str
    not_before: datetime
    not_after: datetime
    http_context: ssl.SSLContext = field(repr=False)


def _read(path: Path, setting: str) -> bytes:
    try:
        with path.open("rb") as file:
            content = file.read(_LARGEST_FILE_BYTES + 1)
    except OSError as error:
        raise _unusable(setting, f"{path} cannot be read: {error.strerror}") from None
    if len(content) > _LARGEST_FILE_BYTES:
        raise _unusable(setting, f"{path} is larger than {_LARGEST_FILE_BYTES} bytes, which no PEM file of keys is")
    return content


def _names(certificate: x509.Certificate) -> str:
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ", ".join(str(one.value) for one in certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME))
    return ", ".join(str(name.value) for name in names)


def _unusable(setting: str, reason: str) -> StartupFailed:
    return StartupFailed(f"{setting} cannot be used: {reason}", field=setting)


_POLL_S = 1.0
_REMIND_S = 3600.0
_LATE_SHARE = 0.1  # of a certificate's life: by then it should have been renewed

_log = logging.getLogger("ultragray.tls")


class CertificateWatch:
    """The certificates in use. Files that cannot be used leave the last good ones in their place."""

    def __init__(self, files: CertificateFiles) -> None:
        self._files = files
        self._last_report: tuple[str, float] | None = None
        self.current = files.load(files.read())
        _tell_in_use(self.current)

    @classmethod
    def of(cls, settings: Settings) -> CertificateWatch | None:
        if settings.tls_certificate is None or settings.tls_key is None:
            return None
        return cls(CertificateFiles(settings.tls_certificate, settings.tls_key, settings.tls_client_ca))

    async def follow(self) -> None:
        rounds = Rounds("the watch over TLS certificates", _log)
        while True:
            await asyncio.sleep(_POLL_S)
            with rounds.round():
                before = self.current
                problem = await asyncio.to_thread(self._update)  # a disk may be slow
                if self.current is not before:
                    _tell_in_use(self.current)
                self._tell_problem(problem or _lateness(self.current))

    def _update(self) -> str | None:
        """Takes over files that changed. What is wrong with them, if anything is."""
        try:
            content = self._files.read()
            if content != self.current.content:
                self.current = self._files.load(content)
        except StartupFailed as error:
            return error.detail
        return None

    def _tell_problem(self, problem: str | None) -> None:
        now = time.monotonic()
        if problem is None:
            self._last_report = None
        elif self._last_report is None or self._last_report[0] != problem or now - self._last_report[1] >= _REMIND_S:
            self._last_report = problem, now
            _log.error("%s; the doors go on with the certificate valid until %s", problem, self.current.not_after)


def _lateness(certificates: Certificates) -> str | None:
    now = datetime.now(timezone.utc)
    time_left = certificates.not_after - now
    if now > certificates.not_after:
        return "tls_certificate has expired: clients refuse it"
    if time_left < _LATE_SHARE * (certificates.not_after - certificates.not_before):
        return "tls_certificate expires soon"
    return None


def _tell_in_use(certificates: Certificates) -> None:
    fields = {"tls_names": certificates.names, "tls_not_after": certificates.not_after.isoformat()}
    _log.info(
        "TLS certificate of %s, valid until %s", certificates.names, certificates.not_after, extra={"fields": fields}
    )

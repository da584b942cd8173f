"""Certificates that follow their files while the doors are open."""

from __future__ import annotations

import asyncio
import logging
import time
from datetime import datetime, timezone

from ultragray_service.settings import Settings
from ultragray_service.tls.certificates import CertificateFiles, Certificates
from ultragray_workers.errors import StartupFailed
from ultragray_workers.rounds import Rounds

_POLL_S = 1.0
_REMIND_S = 3600.0
_LATE_SHARE = 0.1  # of a certificate's life: by then it should have been renewed

_log = logging.getLogger("ultragray.tls")


class CertificateWatch:
    """The certificates in use. Files that cannot be used leave the last good ones in their place."""

    def __init__(self, files: CertificateFiles) -> None:
        """Raises StartupFailed where the files cannot be used."""
        self._files = files
        self._told: tuple[str, float] | None = None
        self.current = files.load(files.read())
        _tell_in_use(self.current)

    @classmethod
    def of(cls, settings: Settings) -> CertificateWatch | None:
        """The watch over the files of the settings; None: the doors speak no TLS. Raises StartupFailed."""
        if settings.tls_certificate is None or settings.tls_key is None:
            return None
        return cls(CertificateFiles(settings.tls_certificate, settings.tls_key, settings.tls_client_ca))

    async def follow(self) -> None:
        """Looks at the files for ever; tells in the log what is in use and what is wrong."""
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
            self._told = None
        elif self._told is None or self._told[0] != problem or now - self._told[1] >= _REMIND_S:
            self._told = problem, now
            _log.error("%s; the doors go on with the certificate valid until %s", problem, self.current.not_after)


def _lateness(certificates: Certificates) -> str | None:
    now = datetime.now(timezone.utc)
    left = certificates.not_after - now
    if now > certificates.not_after:
        return "tls_certificate has expired: clients refuse it"
    if left < _LATE_SHARE * (certificates.not_after - certificates.not_before):
        return "tls_certificate expires soon"
    return None


def _tell_in_use(certificates: Certificates) -> None:
    fields = {"tls_names": certificates.names, "tls_not_after": certificates.not_after.isoformat()}
    _log.info(
        "TLS certificate of %s, valid until %s", certificates.names, certificates.not_after, extra={"fields": fields}
    )

"""The addresses at which a service answers, told when it is ready: to people as a banner, to programs as a record."""

from __future__ import annotations

from dataclasses import dataclass

from ultragray.contract import described
from ultragray.installation import __version__
from ultragray_service.access.principals import is_loopback
from ultragray_service.listening import authority
from ultragray_service.settings import Settings

_ANY = ("0.0.0.0", "::")  # not addresses that a browser can open
_LABEL_WIDTH = 12


@dataclass(frozen=True, kw_only=True)
class ServiceInfo:
    """What a service is, and the ports that it answers on beside this one."""

    version: str
    tls: bool = described("Whether HTTP and gRPC speak TLS. A proxy in front may add it.")
    grpc_port: int = described("As the service has it; a proxy in front may have another.")
    igtl_port: int | None = described("Of OpenIGTLink; null: off.")
    igtl_is_local: bool = described("Whether OpenIGTLink answers programs on the service's own machine alone.")
    key_required: bool = described("Whether HTTP and gRPC ask for an API key or a token.")


@dataclass(frozen=True)
class Doors:
    """Where HTTP, gRPC and, where it has a port, OpenIGTLink answer."""

    settings: Settings
    http: str  # URL
    grpc: str
    igtl: str | None

    @classmethod
    def of(cls, settings: Settings, http_port: int, grpc_port: int, igtl: str | None) -> Doors:
        scheme = "https" if settings.tls_certificate is not None else "http"
        http = f"{scheme}://{authority(settings.host, http_port)}"
        return cls(settings, http, authority(settings.host, grpc_port), igtl)

    def info(self, *, key_required: bool) -> ServiceInfo:
        """The doors as pages need them, which know by themselves at which host they found the service."""
        return ServiceInfo(
            version=__version__,
            tls=self.settings.tls_certificate is not None,
            grpc_port=_port_of(self.grpc),
            igtl_port=None if self.igtl is None else _port_of(self.igtl),
            igtl_is_local=is_loopback(self.settings.host) or not self.settings.igtl_allow,
            key_required=key_required,
        )

    def fields(self) -> dict[str, str]:
        values = {"http": self.http, "grpc": self.grpc, "docs": f"{self.http}/docs"}
        values["data_folder"] = str(self.settings.data_folder)
        return values if self.igtl is None else {**values, "igtl": self.igtl}

    def in_words(self) -> str:
        tls = " with TLS" if self.settings.tls_certificate is not None else ""
        sentence = f"serving HTTP on {self.http} (docs at {self.http}/docs) and gRPC on {self.grpc}{tls}"
        return sentence if self.igtl is None else f"{sentence}, OpenIGTLink on {self.igtl}"

    def banner(self, asks_for_keys: bool) -> str:
        host = self.settings.host
        scheme, port = self.http.partition(":")[0], self.http.rpartition(":")[2]
        http = f"{scheme}://localhost:{port}" if host in _ANY else self.http
        lines = {
            "console": f"{http}/",
            "HTTP docs": f"{http}/docs",
            "gRPC": self.grpc,
            "OpenIGTLink": self.igtl,
            "scenes": str(self.settings.data_folder),
            "API key": self._about_keys(asks_for_keys),
            "stop": "Ctrl-C",
        }
        rows = (f"  {name:<{_LABEL_WIDTH}}{value}\n" for name, value in lines.items() if value is not None)
        return f"\nUltraG-Ray {__version__} is ready\n{''.join(rows)}\n"

    def _about_keys(self, asks_for_keys: bool) -> str:
        if asks_for_keys:
            return "needed"
        return (
            "not needed: this machine alone is served" if is_loopback(self.settings.host) else "NOT NEEDED BY ANYBODY"
        )


def _port_of(address: str) -> int:
    return int(address.rpartition(":")[2])

"""Sockets as this service sets them up."""

from __future__ import annotations

import errno
import logging
import resource
import socket
import sys

from ultragray_service.settings import ENVIRONMENT_PREFIX
from ultragray_workers.errors import StartupFailed

_BACKLOG = 2048

_log = logging.getLogger("ultragray.service")


def listen(host: str, port: int, what: str, field: str) -> socket.socket:
    """A socket that listens. Raises StartupFailed, naming the setting `field`, where the port cannot be had."""
    listener = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except OSError as error:
        listener.close()
        raise StartupFailed(
            f"{what} cannot listen on {authority(host, port)}: {_remedy(error, field)}", field=field
        ) from error
    listener.listen(_BACKLOG)
    listener.setblocking(False)
    return listener


def check_port_is_free(host: str, port: int, what: str, field: str) -> None:
    """Raise StartupFailed as `listen` does, for a server that opens its socket itself and says less."""
    if port:
        listen(host, port, what, field).close()


def _remedy(error: OSError, field: str) -> str:
    """Why a port cannot be had, and what to give instead."""
    if error.errno == errno.EADDRINUSE:
        return f"the port is in use; give another one with {_named(field)}"
    reason = (error.strerror or str(error)).lower()
    return f"{reason}; give another address with {_named('host')}, or another port with {_named(field)}"


def _named(field: str) -> str:
    return f"--{field.replace('_', '-')} or {ENVIRONMENT_PREFIX}{field.upper()}"


def authority(host: str, port: int) -> str:
    """Host and port as a URL has them."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def give_up_on_silent_peers(connection: socket.socket, patience_s: float) -> None:
    """Let the kernel end a connection whose peer takes nothing for so long, also after it was closed here."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)  # to notice one that has vanished
    if sys.platform == "linux":
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(1000 * patience_s))


def raise_open_files_limit(wanted: int) -> None:
    """Raise the limit of open files to `wanted`, or as far as the hard limit allows, and warn where that is less."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    possible = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
    if soft != resource.RLIM_INFINITY and soft < possible:
        resource.setrlimit(resource.RLIMIT_NOFILE, (possible, hard))
    if possible < wanted:
        _log.warning(
            f"this process may open {hard} files, {wanted} are needed for all connections that the settings allow: "
            "raise the hard limit (ulimit -n, LimitNOFILE of systemd)"
        )

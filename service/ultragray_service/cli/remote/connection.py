"""The options by which commands find a running service, and the connection that they make."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from ultragray_service.cli.options import keyword, with_parameters
from ultragray_service.cli.terminal import warn
from ultragray_service.environment import ADDRESS, API_KEY, CA, CLIENT_CERTIFICATE, CLIENT_KEY

CONNECTION, TLS = "Connection", "TLS"


def _option(help: str, envvar: str, panel: str, show_default: str | bool) -> Any:
    return typer.Option(help=help, envvar=envvar, rich_help_panel=panel, show_default=show_default)


_OPTIONS = [
    keyword(
        "address",
        Annotated[str, _option("URL of the service.", ADDRESS, CONNECTION, True)],
        "http://127.0.0.1:8000",
    ),
    keyword(
        "api_key", Annotated[str | None, _option("Where the service asks for one.", API_KEY, CONNECTION, False)], None
    ),
    keyword(
        "ca",
        Annotated[
            Path | None,
            _option("Authorities (PEM) that sign the service's certificate.", CA, TLS, "the system's"),
        ],
        None,
    ),
    keyword(
        "client_certificate",
        Annotated[
            Path | None,
            _option("Certificate (PEM) of the client, where the service asks for one.", CLIENT_CERTIFICATE, TLS, False),
        ],
        None,
    ),
    keyword(
        "client_key", Annotated[Path | None, _option("Its key (PEM), not encrypted.", CLIENT_KEY, TLS, False)], None
    ),
]


def with_connection(command: Callable[..., None]) -> Callable[..., None]:
    """Make a command of a function that takes a `connection` first: with the options of the connection."""
    hints = get_type_hints(command, localns={"Connection": Any}, include_extras=True)  # imported when a command runs
    own = [
        parameter.replace(annotation=hints[name], kind=parameter.KEYWORD_ONLY)
        for name, parameter in inspect.signature(command).parameters.items()
        if name != "connection"
    ]

    @wraps(command)
    def run(
        *,
        address: str,
        api_key: str | None,
        ca: Path | None,
        client_certificate: Path | None,
        client_key: Path | None,
        **given: Any,
    ) -> None:
        from ultragray_service.remote.connection import Connection
        from ultragray_service.tls.client import client_context, exposes_key

        connection = Connection(address, api_key, client_context(ca, client_certificate, client_key))
        if api_key is not None and exposes_key(address):
            warn(f"the API key travels unencrypted to {address}, and whoever is on the way can read it")
        command(connection, **given)

    return with_parameters(run, [*own, *_OPTIONS])

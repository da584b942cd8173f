"""The environment variables that the project reads, and a word on those that look like them but are none."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from difflib import get_close_matches

PREFIX = "ULTRAGRAY_"

# Of the commands that ask a running service.
ADDRESS = "ULTRAGRAY_ADDRESS"
API_KEY = "ULTRAGRAY_API_KEY"
CA = "ULTRAGRAY_CA"
CLIENT_CERTIFICATE = "ULTRAGRAY_CLIENT_CERTIFICATE"
CLIENT_KEY = "ULTRAGRAY_CLIENT_KEY"
COMMAND_VARIABLES = (ADDRESS, API_KEY, CA, CLIENT_CERTIFICATE, CLIENT_KEY)

OTHER_VARIABLES = ("ULTRAGRAY_DATABASE_PASSWORD",)  # docker/compose.yaml makes a setting of it


def unknown_variables(environment: Mapping[str, str] | None = None) -> Iterable[str]:
    """A sentence for each variable that begins like ours and is none, with the one that was perhaps meant."""
    given = [name for name in (os.environ if environment is None else environment) if name.startswith(PREFIX)]
    if all(name in COMMAND_VARIABLES for name in given):
        return
    known = known_variables()
    for name in sorted(set(given) - set(known)):
        near = get_close_matches(name, known, n=1, cutoff=0.8)
        yield f"the environment variable {name} is not known and is ignored" + (
            f"; did you mean {near[0]}?" if near else ""
        )


def known_variables() -> tuple[str, ...]:
    """Every variable that is read, those of the settings included."""
    from ultragray.contract import annotated_fields

    from .settings import Settings

    settings = (f"{PREFIX}{item.name.upper()}" for item, _ in annotated_fields(Settings))
    return (*settings, *COMMAND_VARIABLES, *OTHER_VARIABLES)

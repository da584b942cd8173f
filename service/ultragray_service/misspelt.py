"""A word on environment variables that look like ours and are none: they would be ignored in silence."""

from __future__ import annotations

import os
from collections.abc import Iterator
from difflib import get_close_matches

from ultragray_service.environment import COMMAND_VARIABLES, OTHER_VARIABLES, PREFIX


def unknown_variables() -> Iterator[str]:
    """A sentence for each variable that begins like ours and is none, with the one that was perhaps meant."""
    names = {name for name in os.environ if name.startswith(PREFIX)} - set(COMMAND_VARIABLES)
    if not names:
        return  # the usual case; to know the settings takes a while
    known = known_variables()
    words = [one.removeprefix(PREFIX) for one in known]  # what they share makes none of them more alike
    for name in sorted(names - set(known)):
        near = get_close_matches(name.removeprefix(PREFIX), words, n=1, cutoff=0.8)
        perhaps = f"; did you mean {PREFIX}{near[0]}?" if near else ""
        yield f"the environment variable {name} is not known and is ignored{perhaps}"


def known_variables() -> tuple[str, ...]:
    from ultragray.contract import annotated_fields
    from ultragray_service.settings import Settings

    settings = (f"{PREFIX}{item.name.upper()}" for item, _ in annotated_fields(Settings))
    return (*settings, *COMMAND_VARIABLES, *OTHER_VARIABLES)

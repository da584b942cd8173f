"""The version that a file of ours names: one of this release, or a sentence that says what to do."""

from __future__ import annotations

from typing import Any


def require_version(found: Any, known: int) -> None:
    """Raises ValueError where a file is of another version than the release reads."""
    if type(found) is int and found > known:
        raise ValueError(
            f"its format_version is {found}, this release reads {known}: a newer release wrote it, use that one or a "
            "newer one to read it"
        )
    if type(found) is not int or found != known:
        raise ValueError(f"its format_version is {found!r}, this release reads {known}")

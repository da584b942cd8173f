"""Names of scenes, and names with a pin, which ask for one content of a scene: `liver@3f7a9c0d12e4`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from ultragray.errors import InvalidArgument
from ultragray.scene.compressed import COMPRESSED_SUFFIX

SUFFIX = ".ugr"
SUFFIXES = (SUFFIX, COMPRESSED_SUFFIX)  # what is in a file, and not its name, says whether it is compressed
LEAST_PIN = 12  # digits
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")
_PIN = re.compile(rf"[0-9a-f]{{{LEAST_PIN},64}}")


@dataclass(frozen=True)
class SceneReference:
    """A scene as somebody asks for it. `pin`: what the SHA-256 of its file begins with; None: whatever it is now."""

    name: str
    pin: str | None = None

    @classmethod
    def of(cls, text: str) -> SceneReference | None:
        """The reference that a text is; None where it can be none."""
        name, at, pin = text.partition("@")
        if not is_scene_name(name) or (at and not _PIN.fullmatch(pin)):
            return None
        return cls(name, pin if at else None)

    def fits(self, sha256: str) -> bool:
        """Whether it asks for the content of that hash."""
        return self.pin is None or sha256.startswith(self.pin)


def is_scene_name(name: str) -> bool:
    """Whether a scene can have the name: a part of a URL, of a path and of a key."""
    return _NAME.fullmatch(name) is not None


def base_name(text: str) -> str:
    return text.partition("@")[0]


def check_scene_name(name: Any, field: str = "scene") -> None:
    """Raises InvalidArgument for a name that no scene can have."""
    if not isinstance(name, str) or not is_scene_name(name):
        raise InvalidArgument(
            f"{field} must be 1 to 128 letters, digits, '.', '_', '-', got {str(name)[:128]!r}", field=field
        )


def check_scene_reference(text: Any, field: str = "scene") -> None:
    """Raises InvalidArgument for a name, with or without a pin, that no scene can have."""
    if isinstance(text, str) and "@" in text:
        if SceneReference.of(text) is None:
            raise InvalidArgument(
                f"{field} must be the name of a scene, then @ and {LEAST_PIN} to 64 digits of its SHA-256 (0-9, a-f) "
                f"where it is pinned, got {text[:200]!r}",
                field=field,
            )
    else:
        check_scene_name(text, field)

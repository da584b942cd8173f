"""Puts the gRPC stubs, `ultragray_proto`, into the wheel and the sdist: they live beside this project, in ../proto."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PACKAGE = "ultragray_proto"


class StubsHook(BuildHookInterface):  # type: ignore[type-arg]
    """In an sdist they lie at its root, so that a wheel can be built from it alone."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if version == "editable":
            return  # then they are found where they are: dev-mode-dirs
        folders = (Path(self.root).parent / "proto" / PACKAGE, Path(self.root) / PACKAGE)
        source = next(folder for folder in folders if folder.is_dir())
        for path in sorted(source.rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts:
                build_data["force_include"][str(path)] = f"{PACKAGE}/{path.relative_to(source).as_posix()}"

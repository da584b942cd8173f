"""The build backend of `ultragray`: scikit-build-core, after a check that the build can succeed.

A build that cannot ends with one sentence on stderr instead of CMake's output. Building wheels and sdists also needs
the console; an editable install serves the one of the checkout, as soon as there is one.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

import scikit_build_core.build as scikit
from scikit_build_core.build import prepare_metadata_for_build_editable, prepare_metadata_for_build_wheel

from prerequisites import compiler_problem, console_problem, headers_problem

__all__ = [
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
    "prepare_metadata_for_build_editable",
    "prepare_metadata_for_build_wheel",
]

Settings = dict[str, Any] | None


def _stop_at(problems: Iterable[str | None]) -> None:
    found = [problem for problem in problems if problem]
    if found:
        sys.exit("\n".join(f"error: {problem}" for problem in found))


# The requirements are asked for before anything large is downloaded, so this is where problems are told.
def get_requires_for_build_wheel(config_settings: Settings = None) -> list[str]:
    _stop_at([console_problem(), headers_problem(), compiler_problem()])
    return scikit.get_requires_for_build_wheel(config_settings)


def get_requires_for_build_editable(config_settings: Settings = None) -> list[str]:
    _stop_at([headers_problem(), compiler_problem()])
    return scikit.get_requires_for_build_editable(config_settings)


def get_requires_for_build_sdist(config_settings: Settings = None) -> list[str]:
    _stop_at([console_problem()])
    return scikit.get_requires_for_build_sdist(config_settings)


# A frontend that does not isolate builds asks for no requirements.
def build_wheel(wheel_directory: str, config_settings: Settings = None, metadata_directory: str | None = None) -> str:
    _stop_at([console_problem(), headers_problem(), compiler_problem()])
    return scikit.build_wheel(wheel_directory, config_settings, metadata_directory)


def build_editable(
    wheel_directory: str, config_settings: Settings = None, metadata_directory: str | None = None
) -> str:
    _stop_at([headers_problem(), compiler_problem()])
    return scikit.build_editable(wheel_directory, config_settings, metadata_directory)


def build_sdist(sdist_directory: str, config_settings: Settings = None) -> str:
    _stop_at([console_problem()])
    return scikit.build_sdist(sdist_directory, config_settings)

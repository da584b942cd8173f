"""What a build needs from the machine, and the sentence for what is missing. The standard library alone.

`python distribution/prerequisites.py` prints what an editable install with this Python lacks, and exits with 1.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

CONSOLE_PAGE = Path(__file__).resolve().parent.parent / "service/ultragray_service/console/index.html"
_COMPILERS = ("c++", "g++", "clang++")  # in the order in which CMake takes them
_CPP17 = "#include <optional>\n#include <string_view>\nint main() { if (std::optional<int> a = 1; a) return 0; }\n"


def _to_install(debian_package: str) -> str:
    if shutil.which("apt-get"):
        return f"to install: sudo apt-get install {debian_package}"
    return f"install what Debian calls {debian_package}"


def headers_problem() -> str | None:
    header = Path(sysconfig.get_path("include"), "Python.h")
    if header.is_file():
        return None
    package = f"python{sys.version_info.major}.{sys.version_info.minor}-dev"
    return f"the headers of Python are missing ({header} does not exist); {_to_install(package)}"


def compiler_problem() -> str | None:
    """Only where compilers are found by PATH: Windows has its own way."""
    if os.name != "posix":
        return None
    command = shlex.split(os.environ.get("CXX", "")) or [next(filter(shutil.which, _COMPILERS), "")]
    if not command[0]:
        return f"a C++17 compiler and its library are missing; {_to_install('g++')}"
    try:
        arguments = ["-std=c++17", "-fsyntax-only", "-x", "c++", "-"]
        done = subprocess.run([*command, *arguments], input=_CPP17, capture_output=True, text=True)
    except OSError as error:
        return f"the C++ compiler {command[0]!r}, which CXX names, does not start ({error.strerror})"
    if done.returncode == 0:
        return None
    return f"the C++ compiler {command[0]} or its library is too old for C++17, or incomplete; {_to_install('g++')}"


def console_problem() -> str | None:
    if CONSOLE_PAGE.is_file():
        return None
    return (
        "the console is not built, and a wheel or sdist without it would serve no page; run `make console` first "
        "(needs Node 20 or newer), or install the checkout itself: pip install --editable ."
    )


if __name__ == "__main__":
    problems = [problem for problem in (headers_problem(), compiler_problem()) if problem]
    sys.exit("\n".join(f"error: {problem}" for problem in problems) if problems else 0)

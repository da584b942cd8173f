"""`python -m ultragray_service`: serves with the settings of the environment (ULTRAGRAY_…)."""

from __future__ import annotations

import sys

from ultragray.errors import UltragrayError
from ultragray_service.server import run
from ultragray_service.settings import load_settings


def main() -> int:
    """Serve until SIGTERM or SIGINT: 0 after a clean stop, 1 and a sentence on stderr where it cannot start."""
    try:
        run(load_settings())
    except UltragrayError as error:
        sys.stderr.write(f"ultragray: {error.detail}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())

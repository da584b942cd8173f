"""The environment variables that the project reads, but for those of single settings, and the one that it sets."""

from __future__ import annotations

import os

PREFIX = "ULTRAGRAY_"  # of all; a setting's has its name behind it

# Of the commands that ask a running service.
ADDRESS = "ULTRAGRAY_ADDRESS"
API_KEY = "ULTRAGRAY_API_KEY"
CA = "ULTRAGRAY_CA"
CLIENT_CERTIFICATE = "ULTRAGRAY_CLIENT_CERTIFICATE"
CLIENT_KEY = "ULTRAGRAY_CLIENT_KEY"
COMMAND_VARIABLES = (ADDRESS, API_KEY, CA, CLIENT_CERTIFICATE, CLIENT_KEY)

OTHER_VARIABLES = ("ULTRAGRAY_DATABASE_PASSWORD",)  # docker/compose.yaml makes a setting of it


def wait_without_spinning() -> None:
    """Have torch's threads sleep while they wait for each other, in this process and those that it starts.

    Before torch is imported. Where others use the processors too, a thread that spins keeps the one away that it waits
    for: beside six busy programs on two cores a training step took 1,500 ms, asleep 90. What the environment says
    goes before.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")

"""The names of the environment variables that the project reads, but for those of single settings."""

from __future__ import annotations

PREFIX = "ULTRAGRAY_"  # of all; a setting's has its name behind it

# Of the commands that ask a running service.
ADDRESS = "ULTRAGRAY_ADDRESS"
API_KEY = "ULTRAGRAY_API_KEY"
CA = "ULTRAGRAY_CA"
CLIENT_CERTIFICATE = "ULTRAGRAY_CLIENT_CERTIFICATE"
CLIENT_KEY = "ULTRAGRAY_CLIENT_KEY"
COMMAND_VARIABLES = (ADDRESS, API_KEY, CA, CLIENT_CERTIFICATE, CLIENT_KEY)

OTHER_VARIABLES = ("ULTRAGRAY_DATABASE_PASSWORD", "ULTRAGRAY_STORAGE_PASSWORD")  # of the compose files

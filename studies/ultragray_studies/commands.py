"""The commands that this distribution adds to `ultragray`: found by their entry point, imported when they are used."""

from __future__ import annotations

from ultragray_service.cli.app import Entry

PANEL = "Studies"
COMMANDS = (
    Entry(
        "compare",
        "ultragray_studies.compare_command:command_app",
        PANEL,
        "Compare this and other methods on the same frames.",
    ),
    Entry(
        "report",
        "ultragray_studies.report_command:command_app",
        PANEL,
        "Train, measure and compare; write one HTML page.",
    ),
    Entry(
        "bench", "ultragray_studies.bench.cli:command_app", PANEL, "Measure the kernel and the service on this machine."
    ),
)

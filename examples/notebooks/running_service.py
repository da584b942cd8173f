"""A service of one scene while a `with` block runs, for notebooks: they must not need a second terminal."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

START_TIMEOUT_S = 120.0


@contextmanager
def serving(scene_file: Path) -> Iterator[str]:
    """Runs `ultragray serve SCENE_FILE` on free ports; the address of its gRPC. Raises RuntimeError with its log."""
    command = [Path(sys.executable).with_name("ultragray"), "serve", scene_file]
    options = ["--http-port", "0", "--grpc-port", "0", "--log-format", "json"]
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "service.log"
        with log.open("wb") as output:
            service = subprocess.Popen(
                [*command, *options], cwd=folder, stdin=subprocess.DEVNULL, stdout=output, stderr=output
            )
        try:
            yield _address(service, log)
        finally:
            service.terminate()
            service.wait()


def _address(service: subprocess.Popen[bytes], log: Path) -> str:
    """The address that the log tells once the service is ready."""
    end_s = time.monotonic() + START_TIMEOUT_S
    while service.poll() is None and time.monotonic() < end_s:
        whole = log.read_text(errors="replace").rpartition("\n")[0]  # the last line may be half written
        for line in whole.splitlines():
            if line.startswith("{") and "grpc" in (record := json.loads(line)):
                return str(record["grpc"])
        time.sleep(0.05)
    raise RuntimeError(f"the service did not start:\n{log.read_text(errors='replace')}")

"""The OpenIGTLink tables of docs/interfaces.md say what the code does; the service process stays free of torch."""

from __future__ import annotations

import re
import subprocess
import sys

from ultragray_service.igtl import connection, waiting
from ultragray_service.igtl.kinds import CAPABILITY
from ultragray_service.igtl.messages import Message

from ..conftest import ROOT
from .conftest import Peer

DOCUMENT = (ROOT / "docs" / "interfaces.md").read_text(encoding="utf-8")


def first_cells(heading: str) -> list[list[str]]:
    """The words in backticks of each row of the table below a heading."""
    section = re.split(r"^#+ ", DOCUMENT.partition(f"### {heading}\n")[2], maxsplit=1, flags=re.MULTILINE)[0]
    return [re.findall(r"`([^`]+)`", line) for line in section.splitlines() if line.startswith("|")][2:]


def test_messages() -> None:
    assert sorted(words[0] for words in first_cells("OpenIGTLink messages")) == sorted(CAPABILITY)


def test_limits() -> None:
    assert [float(words[0]) for words in first_cells("OpenIGTLink limits")] == [
        waiting.MAX_WAITING_DEVICES,
        connection.MAX_BODY_BYTES,
        connection.MAX_SKIPPED_BYTES,
        connection.MESSAGE_TIMEOUT_S,
        connection.SEND_TIMEOUT_S,
    ]


def test_metadata(peer: Peer) -> None:
    peer.send("POSITION", "demo", bytes(12), version=2)
    answer: Message = peer.receive()
    documented = [words[0] for words in first_cells("OpenIGTLink metadata")]
    documented.remove("confidence")  # the scene has no model
    assert documented == list(answer.metadata)


def test_the_server_is_free_of_torch() -> None:
    code = "import sys; import ultragray_service.igtl.server; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0

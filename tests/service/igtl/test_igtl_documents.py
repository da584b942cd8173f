"""The metadata of OpenIGTLink are those of the reference; the service process stays free of torch."""

from __future__ import annotations

import subprocess
import sys

from ultragray_service.igtl.messages import Message

from ...documents.tables import code, rows
from .conftest import Peer
from .test_igtl_commands import set_to


def test_metadata(peer: Peer) -> None:
    set_to(peer, Tools='[{"kind": "needle", "tip_mm": [0, 0, 9], "hub_mm": [-9, 0, 0]}]')
    peer.send("POSITION", "demo", bytes(12), version=2)
    answer: Message = peer.receive()
    documented = [code(cells[0])[0] for cells in rows("openigtlink.md", "Metadata")]
    for missing in ("confidence", "registration", "probe_to_scene"):  # the scene has no model, nothing led the pose
        documented.remove(missing)
    assert documented == list(answer.metadata)


def test_the_server_is_free_of_torch() -> None:
    code = "import sys; import ultragray_service.igtl.server; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0

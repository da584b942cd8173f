"""The bench of clients, with tiny numbers."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ultragray_service.bench import clients as bench
from ultragray_service.bench import report
from ultragray_service.bench.clients import ClientsExtent


@pytest.mark.long
def test_bench_of_clients(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny = ClientsExtent(loop_s=1.0, stream_s=0.3, ping_pongs=5, frames=12, gaussians=500, kernel_repeats=3, side=32)
    monkeypatch.setattr(report, "time_yard_ms", lambda: 4.0)
    monkeypatch.setattr(bench, "ClientsExtent", lambda **less: tiny)
    bench.run(tmp_path / "clients.json", quick=True)
    clients = json.loads((tmp_path / "clients.json").read_text())["clients"]
    assert list(clients) == [
        "control loop",
        "WebSocket, 1 client(s)",
        "WebSocket, 8 client(s)",
        "OpenIGTLink",
        "augmentation",
    ]
    loop, augmentation = clients["control loop"], clients["augmentation"]
    assert 0 < loop["p50_ms"] <= loop["p99_ms"] <= loop["p99.9_ms"]
    assert loop["frames_per_s"] == pytest.approx(60, rel=0.5)
    assert augmentation["share_of_kernel"] == pytest.approx(
        augmentation["frames_per_s"] / augmentation["kernel_frames_per_s"]
    )

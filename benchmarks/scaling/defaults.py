"""What the simulation decided. docs/scaling.md has the figures that speak for each value."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Defaults:
    """The values that Envoy's configuration and the chart take."""

    hash_balance_factor: int = 110  # per cent of the mean that one replica may have of open requests and streams
    minimum_ring_size: int = 65_536  # points of the ring: 66 for each of 1,000 replicas
    one_home: bool = False  # of a scene behind both doors: replicas under one DNS name are hashed with ports
    keys_of_hot_scene: int = 1  # the bound spreads it
    memory_budget_mb: int = 4096  # of loaded scenes, the service's own default
    utilisation: float = 0.5  # share of its time that a replica works; more replicas are wanted above
    queue_p95_ms: float = 12.0  # 95% of frames wait less; more replicas are wanted above


DEFAULTS = Defaults()

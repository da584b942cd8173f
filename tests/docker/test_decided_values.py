"""Envoy and the chart take the values that the simulation decided."""

from __future__ import annotations

import yaml

from ultragray_studies.scaling import DECIDED

from ..surroundings import ROOT
from .envoy import FOLDER


def test_rings_have_the_decided_size_and_bound() -> None:
    document = yaml.safe_load((FOLDER / "envoy.yaml").read_text(encoding="utf-8"))
    rings = [one for one in document["static_resources"]["clusters"] if one["lb_policy"] == "RING_HASH"]
    assert len(rings) == 2
    for ring in rings:
        assert ring["ring_hash_lb_config"] == {"minimum_ring_size": DECIDED.minimum_ring_size}
        bound = ring["common_lb_config"]["consistent_hashing_lb_config"]
        assert bound == {"hash_balance_factor": DECIDED.hash_balance_factor}


def test_replicas_are_added_at_the_decided_wait() -> None:
    values = yaml.safe_load((ROOT / "docker/helm/values.yaml").read_text(encoding="utf-8"))
    assert values["service"]["autoscaling"]["queueDelaySeconds"] == DECIDED.queue_p95_ms / 1000

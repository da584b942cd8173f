"""Envoy and the chart take the values that docs/scaling.md says were decided."""

from __future__ import annotations

import yaml

from ..documents.tables import rows
from ..surroundings import ROOT
from .envoy import FOLDER

DECIDED = dict(rows("../scaling.md", "What was decided"))


def test_rings_have_the_decided_size_and_bound() -> None:
    document = yaml.safe_load((FOLDER / "envoy.yaml").read_text(encoding="utf-8"))
    rings = [one for one in document["static_resources"]["clusters"] if one["lb_policy"] == "RING_HASH"]
    assert len(rings) == 2
    for ring in rings:
        assert ring["ring_hash_lb_config"] == {"minimum_ring_size": int(DECIDED["Envoy: `minimum_ring_size`"])}
        bound = ring["common_lb_config"]["consistent_hashing_lb_config"]
        assert bound == {"hash_balance_factor": int(DECIDED["Envoy: `hash_balance_factor`"])}


def test_replicas_are_added_at_the_decided_wait() -> None:
    values = yaml.safe_load((ROOT / "docker/helm/values.yaml").read_text(encoding="utf-8"))
    decided_ms = DECIDED["More replicas where 5% of `ultragray_queue_seconds` are above"].removesuffix(" ms")
    assert values["service"]["autoscaling"]["queueDelaySeconds"] == int(decided_ms) / 1000

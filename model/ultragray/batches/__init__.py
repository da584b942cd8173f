"""Batches: frames by the million, rendered as shards that any number of processes make, each once.

`BatchPlan` says what the frames are and which shard has which; `ShardRenderer` makes the file of one shard;
`manifest` lists them when all are there. Engines decide where and when: the queue of jobs, and Ray (ultragray_workers).
"""

from __future__ import annotations

from ultragray.batches.manifest import MANIFEST_FILE, ShardEntry, manifest
from ultragray.batches.names import names_in, stands_for
from ultragray.batches.plan import SHARD_FRAMES, BatchPlan

__all__ = ["MANIFEST_FILE", "SHARD_FRAMES", "BatchPlan", "ShardEntry", "manifest", "names_in", "stands_for"]

"""The manifest of a batch: what was asked for, and each file with its hash. Free of torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from ultragray.batches.plan import BatchPlan
from ultragray.errors import InvalidArgument

MANIFEST_FILE = "manifest.json"


@dataclass(frozen=True)
class ShardEntry:
    """The file of one shard, as it was written."""

    file: str
    first: int  # number of its first frame
    frames: int
    bytes: int
    sha256: str
    renderer: str  # such as ultragray/0.1.0 cpu-avx512
    plan: str  # identity of the plan

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> ShardEntry:
        """Inverse of `asdict`. Raises KeyError, TypeError."""
        return cls(**{item.name: document[item.name] for item in fields(cls)})


def manifest(plan: BatchPlan, entries: Sequence[ShardEntry]) -> dict[str, Any]:
    """The manifest of a batch whose shards are all there, in the order of their files.

    Raises InvalidArgument where they are not exactly the frames of the plan.
    """
    by_file = {entry.file: entry for entry in entries}
    for number in range(plan.shard_count):
        file, frames = plan.file_name(number), plan.frames_of(number)
        entry = by_file.get(file)
        if entry is None:
            raise InvalidArgument(f"{file} is missing: it is no shard of the batch yet")
        if (entry.first, entry.frames, entry.plan) != (frames.start, len(frames), plan.identity):
            raise InvalidArgument(f"{file} is of another batch")
    shards = [{name: value for name, value in asdict(entry).items() if name != "plan"} for entry in entries]
    return {**plan.document(), "plan": plan.identity, "files": plan.file_names, "shards": shards}

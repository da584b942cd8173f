"""The place of a batch: a prefix of a storage with its shards, and at last the manifest.

NAME-000017.tar          a shard, whole
entries/000017.json      its entry, written after it: a shard counts only where this is there
manifest.json            all entries; then they are removed, and the batch is complete

Any number of processes may write the same shard: they write the same bytes. Free of torch.
"""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

from ultragray.errors import InvalidArgument
from ultragray.exchange.batches import MANIFEST_FILE, BatchPlan, ShardEntry, manifest
from ultragray.files import file_sha256, sync
from ultragray_workers.storage.storage import NotThere, Storage

_ENTRIES = "entries"
_AT_ONCE = 16  # small requests to a bucket


class ShardPlace:
    """The files of one batch. Methods block, and raise what those of the storage raise."""

    def __init__(self, storage: Storage, prefix: str, plan: BatchPlan) -> None:
        self.storage, self.plan = storage, plan
        self._prefix = prefix

    def key(self, name: str) -> str:
        return f"{self._prefix}/{name}" if self._prefix else name

    def keep(self, path: Path, shard: int, entry: ShardEntry) -> None:
        """Puts the file of a shard in its place, then says that it is there. `path` is not needed any more."""
        sync(path)
        self.storage.upload(path, self.key(entry.file))
        self.storage.write(self._entry_key(shard), json.dumps(asdict(entry)).encode())

    def entry(self, shard: int) -> ShardEntry | None:
        """The entry of a shard that is there whole; None where it has to be made (again)."""
        try:
            entry = ShardEntry.from_dict(json.loads(self.storage.read(self._entry_key(shard))))
        except (NotThere, ValueError, KeyError, TypeError):
            return None
        is_ours = entry.plan == self.plan.identity and entry.file == self.plan.file_name(shard)
        return entry if is_ours and self._is_whole(entry) else None

    def whole(self) -> list[int]:
        """The shards that are there whole, by what lies in the place: those that need not be made."""
        known = {entry.key for entry in self.storage.entries(self.key(_ENTRIES))}
        shards = [shard for shard in range(self.plan.shard_count) if self._entry_key(shard) in known]
        with ThreadPoolExecutor(_AT_ONCE) as threads:
            return [shard for shard, entry in zip(shards, threads.map(self.entry, shards), strict=True) if entry]

    def is_finished(self) -> bool:
        try:
            manifest = json.loads(self.storage.read(self.key(MANIFEST_FILE)))
        except NotThere:
            return False
        except ValueError:
            manifest = None
        if not isinstance(manifest, dict) or manifest.get("plan") != self.plan.identity:
            raise InvalidArgument(
                f"{self.storage.location} has the {MANIFEST_FILE} of another batch: choose another place",
                field="output",
            )
        return True

    def finish(self) -> None:
        """Writes the manifest. Raises InvalidArgument where a shard is missing."""
        shards = range(self.plan.shard_count)
        with ThreadPoolExecutor(_AT_ONCE) as threads:
            entries = [entry for entry in threads.map(self._written, shards) if entry is not None]
            document = json.dumps(manifest(self.plan, entries), indent=1) + "\n"
            self.storage.write(self.key(MANIFEST_FILE), document.encode())
        self.storage.delete_all(self.key(_ENTRIES))

    def take_over(self, before: ShardPlace) -> None:
        """Takes the whole shards of a batch of the same plan that was not finished, where files can be linked."""
        for shard in before.whole() if before.storage.is_near else ():
            entry = before.entry(shard)
            if entry is not None and (path := before.storage.in_place(before.key(entry.file))) is not None:
                self.keep(path, shard, entry)

    def _written(self, shard: int) -> ShardEntry | None:
        try:
            return ShardEntry.from_dict(json.loads(self.storage.read(self._entry_key(shard))))
        except NotThere:
            return None

    def _is_whole(self, entry: ShardEntry) -> bool:
        """By its size in a bucket, whose objects are whole or absent; by its hash in a folder."""
        item = self.storage.entry(self.key(entry.file))
        if item is None or item.bytes != entry.bytes:
            return False
        path = self.storage.in_place(self.key(entry.file))
        return path is None or file_sha256(path) == entry.sha256

    def _entry_key(self, shard: int) -> str:
        return self.key(f"{_ENTRIES}/{shard:06d}.json")

"""Batches: frames by the million, rendered as shards that any number of processes make, each once. Free of torch.

`BatchPlan` says what the frames are and which shard has which; `ShardRenderer` makes the file of one shard; `manifest`
lists them when all are there. Engines decide where and when: the queue of jobs, and Ray (ultragray_workers).
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from ultragray.contract import made_of, to_dict
from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.rendering.settings import Encoding, FrameSettings, Resolved
from ultragray.samplers import Assess, DrawnSampler, Sampler
from ultragray.samplers.confident import assessed_part
from ultragray.samplers.sampler import BLOCK_POSES
from ultragray.scene.confidence import Extrapolation
from ultragray.scene.info import SceneHeader

_RANGE = re.compile(r"(?P<before>[^{}]*)\{(?P<first>\d{1,9})\.\.(?P<last>\d{1,9})\}(?P<after>[^{}]*)")


def names_in(name: str) -> Iterator[str]:
    """All names that a name stands for: those of its range, or itself."""
    match = _RANGE.fullmatch(name)
    if match is None:
        yield name
        return
    before, first, last, after = match.groups()
    for number in range(int(first), int(last) + 1):
        yield f"{before}{number:0{len(first)}d}{after}"


def stands_for(name: str, one: str) -> bool:
    """Whether `one` is among the names that `name` stands for; none of them is written out."""
    match = _RANGE.fullmatch(name)
    if match is None:
        return name == one
    before, first, last, after = match.groups()
    number = one.removeprefix(before).removesuffix(after)
    is_number = number.isascii() and number.isdecimal() and one == f"{before}{int(number):0{len(first)}d}{after}"
    return is_number and int(first) <= int(number) <= int(last)


SHARD_FRAMES = BLOCK_POSES  # of a shard where nothing else is asked for; a search draws no block twice then
MAX_SHARDS = 20_000  # the queue keeps a row of each, and a manifest names them all
_VERSION = 1  # of how frames follow from a plan: another one gives other plans


@dataclass(frozen=True, eq=False)
class BatchPlan:
    """The frames of a batch and their division into shards: with the scene file, all that an engine needs.

    Frame i is the same however many frames a shard has and whoever renders it: its pose follows from i and the seed of
    the sampler. Plans of one `identity` make the same files, byte for byte on the same kind of processor.
    """

    scene: str  # its name
    scene_sha256: str
    settings: FrameSettings
    sampler: Sampler | None  # makes poses of `poses`
    poses: FloatArray | None  # [P, 4, 4] mm; None: the training poses of the scene
    frames: int
    shard_frames: int
    dtype: str = "uint8"  # of pixels; or float32
    name: str = "frames"  # of the files

    @classmethod
    def prepared(
        cls,
        header: SceneHeader,
        settings: FrameSettings,
        *,
        sampler: Sampler | None,
        poses: FloatArray | None,
        shard_frames: int | None = None,
        **named: str,
    ) -> BatchPlan:
        """The plan for a scene; `named` are scene, scene_sha256, and where they are not the usual ones dtype and name.

        Raises InvalidArgument and its kind for what no frame can be rendered with, or too many shards.
        """
        resolved = settings.resolved(header.info, Encoding.FLOAT32)
        base = header.training_poses if poses is None else check_poses(poses)
        if not len(base):
            raise InvalidArgument("poses must be given: the scene has no training poses", field="poses")
        if sampler is None:
            frames = len(base)
        elif isinstance(sampler, DrawnSampler):
            sampler.with_draws(1, sampler.seed).poses(base, resolved.probe)  # raises where the base does not suffice
            frames = sampler.count
        else:
            frames = len(sampler.poses(base, resolved.probe))
        shard_frames = shard_frames or SHARD_FRAMES
        plan = cls(
            settings=made_of(FrameSettings, settings),
            sampler=sampler,
            poses=None if poses is None else base,
            frames=frames,
            shard_frames=shard_frames,
            **named,
        )
        if plan.shard_count > MAX_SHARDS:
            least = -(-frames // MAX_SHARDS)
            raise InvalidArgument(
                f"shard_frames must be at least {least:,} for {frames:,} frames (at most {MAX_SHARDS:,} shards), got "
                f"{shard_frames:,}",
                field="shard_frames",
            )
        return plan

    @property
    def shard_count(self) -> int:
        return -(-self.frames // self.shard_frames)

    def frames_of(self, shard: int) -> range:
        first = shard * self.shard_frames
        return range(first, min(first + self.shard_frames, self.frames))

    def file_name(self, shard: int) -> str:
        """Such as frames-000017.tar."""
        return f"{self.name}-{shard:06d}.tar"

    @property
    def file_names(self) -> str:
        """The names of all files, as WebDataset writes them: frames-{000000..000199}.tar."""
        last = self.shard_count - 1
        return f"{self.name}-{{000000..{last:06d}}}.tar" if last else self.file_name(0)

    def key(self, frame: int) -> str:
        """The name of a frame within its shard, unique in the batch and of one length."""
        return f"{frame:0{max(6, len(str(self.frames - 1)))}d}"

    def poses_of(
        self, shard: int, training_poses: FloatArray, probe: Probe, assess: Assess
    ) -> tuple[FloatArray, Sequence[Extrapolation]]:  # [P, 4, 4] -> [C, 4, 4] mm, [C]
        """The poses of a shard, and what `assess` finds about each. Raises what `assessed_part` raises."""
        base = training_poses if self.poses is None else self.poses
        places = self.frames_of(shard)
        least = self.settings.least_confidence
        return assessed_part(self.sampler, base, probe, assess, least, places.start, places.stop)

    def resolved(self, header: SceneHeader) -> Resolved:
        return self.settings.resolved(header.info, Encoding.FLOAT32)

    def document(self) -> dict[str, Any]:
        """The plan as a manifest has it; of given poses their number and hash."""
        poses = None if self.poses is None else np.ascontiguousarray(self.poses, "<f8")
        return {
            "version": _VERSION,
            "name": self.name,
            "scene": self.scene,
            "scene_sha256": self.scene_sha256,
            "settings": to_dict(self.settings, with_none=False),
            "sampler": None if self.sampler is None else to_dict(self.sampler, with_none=False),
            "poses": None
            if poses is None
            else {"count": len(poses), "sha256": hashlib.sha256(poses.tobytes()).hexdigest()},
            "dtype": self.dtype,
            "frames": self.frames,
            "shard_frames": self.shard_frames,
        }

    @cached_property
    def identity(self) -> str:
        """Tells the plan from any other: the SHA-256 of its document."""
        return hashlib.sha256(json.dumps(self.document(), sort_keys=True).encode()).hexdigest()


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

"""Rendering the poses of a command line as shards on a cluster."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ultragray.errors import InvalidArgument, InvalidProbe
from ultragray.exchange.batches import MANIFEST_FILE, BatchPlan
from ultragray.exchange.exports.formats import check_format
from ultragray.files.atomic import file_sha256
from ultragray.files.poses import load_poses
from ultragray.samplers import Sampler
from ultragray.samplers.confident import require_drawn
from ultragray.scene_info import read_header
from ultragray.settings import FrameSettings
from ultragray_service.cli.progress import counted
from ultragray_service.cli.style import frames_in_words
from ultragray_workers.batches.on_ray import RayBatch, check_address
from ultragray_workers.storage.opening import open_storage


@dataclass(frozen=True)
class Shards:
    """A batch that is to be rendered, checked without a renderer."""

    scene_file: Path
    plan: BatchPlan

    @classmethod
    def prepared(
        cls,
        scene_file: Path,
        pose_file: Path | None,
        sampler: Sampler | None,
        settings: FrameSettings,
        *,
        dtype: str | None,
        shard_frames: int | None,
    ) -> Shards:
        """The batch of a command line. Raises InvalidArgument and its kind, SceneFileInvalid."""
        poses = None if pose_file is None else load_poses(pose_file)
        header = read_header(scene_file)
        if settings.least_confidence is not None and sampler is not None:
            require_drawn(sampler)
        try:
            plan = BatchPlan.prepared(
                header,
                settings,
                sampler=sampler,
                poses=poses,
                shard_frames=shard_frames,
                scene=scene_file.stem,
                scene_sha256=file_sha256(scene_file),
                dtype=check_format("tar", settings.outputs, dtype),
            )
        except InvalidProbe as error:
            raise InvalidProbe(f"--{error.detail}", field="probe") from None  # as the option is called here
        return cls(scene_file, plan)


@dataclass(frozen=True)
class Sharded:
    """What was rendered, where it is, and how long it took."""

    plan: BatchPlan
    output: str
    seconds: float

    def in_words(self) -> str:
        """One sentence."""
        files = f"{self.plan.file_names} and {MANIFEST_FILE}"
        return f"wrote {self.output}: {frames_in_words(self.plan.frames)} in {files}, in {self.seconds:.1f} s"

    def document(self) -> dict[str, Any]:
        """The same for a program."""
        return {
            "output": self.output,
            "frames": self.plan.frames,
            "shards": self.plan.shard_count,
            "files": self.plan.file_names,
            "manifest": MANIFEST_FILE,
            "plan": self.plan.identity,
            "seconds": round(self.seconds, 3),
        }


def render_shards(shards: Shards, output: str, on: str, *, backend: str, threads: int) -> Sharded:
    """Render what is missing of the batch, and write its manifest.

    Raises InvalidArgument for an output that is no folder or holds something else, and what `RayBatch.render` raises.
    """
    check_address(on)
    storage = open_storage(output)
    if storage.local is not None:
        folder = storage.local.resolve()
        if folder.exists() and not folder.is_dir():
            raise InvalidArgument(f"--output must be a folder with --on, {output} is a file", field="output")
        output = str(folder)  # the workers of a cluster have other working folders
    started = time.perf_counter()
    with counted("rendering", shards.plan.frames) as report:
        RayBatch(shards.plan, shards.scene_file, output, backend, threads or 1).render(on, report)
    return Sharded(shards.plan, output, time.perf_counter() - started)

"""The work of a batch: a process that holds its scene makes one file after another."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch

from ultragray.batches.manifest import ShardEntry
from ultragray.batches.plan import BatchPlan
from ultragray.batches.shard_tar import ShardTar
from ultragray.confidence import Assessor, Extrapolation
from ultragray.display.pixels import PixelArray
from ultragray.errors import InvalidArgument
from ultragray.files.atomic import file_sha256
from ultragray.interchange.exports import ExportHeader
from ultragray.interchange.exports.exporter import stored_pixels
from ultragray.interchange.rendering import render_portions, written_behind
from ultragray.limits import UNLIMITED, Limits
from ultragray.probe import FloatArray
from ultragray.rendering import renderer_name
from ultragray.samplers import Assess
from ultragray.scene import GaussianScene
from ultragray.scene_info import read_header


class ShardRenderer:
    """The scene of a batch, loaded once, and the rendering of its shards."""

    def __init__(
        self,
        plan: BatchPlan,
        scene_file: Path,
        device: torch.device,
        *,
        backend: str = "auto",
        limits: Limits = UNLIMITED,
    ) -> None:
        """Raises InvalidArgument where the file is not the scene of the plan, SceneFileInvalid, BackendUnavailable."""
        if file_sha256(scene_file) != plan.scene_sha256:
            raise InvalidArgument(f"{scene_file.name} is not the scene of the plan: its SHA-256 differs", field="scene")
        self.plan = plan
        self._header = read_header(scene_file)
        self._settings = plan.resolved(self._header)
        self._scene = GaussianScene.load(scene_file).to(device)
        self._assessor = Assessor(self._header.info, self._header.training_poses)
        self._backend, self._limits = backend, limits
        self.renderer = renderer_name(backend, self._scene)

    def render(self, shard: int, path: Path, before_portion: Callable[[int], object] = lambda done: None) -> ShardEntry:
        """Write the file of a shard to `path`; it is not synced.

        `before_portion` is told how many of its frames are done; to stop, it raises. Raises what `BatchPlan.poses_of`
        and `render` raise, and OSError.
        """
        plan, settings, numbers = self.plan, self._settings, self.plan.frames_of(shard)
        assess: Assess = partial(self._assess, before_portion)
        poses, extrapolations = plan.poses_of(shard, self._header.training_poses, settings.probe, assess)
        header = ExportHeader(settings, plan.dtype, poses, plan.scene, plan.scene_sha256, self.renderer)
        done = 0
        with ShardTar(path) as tar:

            def write(frames: dict[str, PixelArray], figures: list[Extrapolation]) -> None:
                nonlocal done
                stored = {name: stored_pixels(pixels, header.pixel_type(name)) for name, pixels in frames.items()}
                places = slice(done, done + len(figures))
                tar.add([plan.key(number) for number in numbers[places]], poses[places], figures, stored)
                done += len(figures)

            with written_behind(write) as later:
                for frames, figures in render_portions(
                    self._scene,
                    settings,
                    poses,
                    extrapolations,
                    backend=self._backend,
                    limits=self._limits.after(numbers.start),
                    before_portion=before_portion,
                    assessor=self._assessor,
                ):
                    later(frames, figures)
            digest = tar.finish()
        return ShardEntry(
            file=plan.file_name(shard),
            first=numbers.start,
            frames=len(numbers),
            bytes=tar.bytes,
            sha256=digest,
            renderer=self.renderer,
            plan=plan.identity,
        )

    def _assess(self, look_up: Callable[[int], object], poses: FloatArray) -> list[Extrapolation]:
        """How far poses extrapolate, some at a time, so that a stop comes soon."""
        at_once = max(1, ASSESSED_AT_ONCE // max(1, len(self._header.training_poses)))
        found: list[Extrapolation] = []
        for first in range(0, len(poses), at_once):
            look_up(0)
            found.extend(self._assessor.assess(poses[first : first + at_once], probe=self._settings.probe))
        return found


ASSESSED_AT_ONCE = 100_000  # poses times training poses, of about a tenth of a second

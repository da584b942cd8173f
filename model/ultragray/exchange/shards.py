"""Shards of a batch: WebDataset tars, of each frame a .npy of each output and a .json with pose and figures.

Written here rather than by `tarfile`, whose members and PNGs took a quarter of the time that the kernel takes for a
frame of 64x64 pixels. Times and owners are 0, so that the same frames are the same bytes.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch

from ultragray.errors import InvalidArgument
from ultragray.exchange.batches import BatchPlan, ShardEntry
from ultragray.exchange.exports import ExportHeader
from ultragray.exchange.exports.exporter import stored_pixels
from ultragray.exchange.rendering import assess_by_rendering, render_portions, written_behind
from ultragray.files import StreamedFile, file_sha256
from ultragray.geometry.probe import FloatArray
from ultragray.rendering.backends.registry import renderer_name
from ultragray.rendering.limits import UNLIMITED, Limits
from ultragray.rendering.pixels import PixelArray
from ultragray.samplers import Assess
from ultragray.scene.confidence import Assessor, Extrapolation
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.info import read_header

_BLOCK, _RECORD = 512, 10_240  # bytes
_MAX_MEMBER = 8**11 - 1  # bytes: what the field of a header holds
_FIGURE_DIGITS = 6


class ShardTar(StreamedFile):
    """A tar that is written portion by portion."""

    def add(
        self,
        keys: Sequence[str],  # [B]
        poses: FloatArray,  # [B, 4, 4] mm
        figures: Sequence[Extrapolation],  # [B]
        frames: Mapping[str, PixelArray],  # [B, H, W] by output
    ) -> None:
        """Append frames. Raises OSError, InvalidArgument for frames larger than a member can be."""
        heads = {name: npy_head(pixels[0]) for name, pixels in frames.items()}
        parts: list[bytes | memoryview] = []
        for place, (key, pose, figure) in enumerate(zip(keys, poses.tolist(), figures, strict=True)):
            for name, pixels in frames.items():
                data = pixels[place].data.cast("B")
                parts += _member(f"{key}.{name}.npy", heads[name], data)
            figures_now = figure.figures().items()
            rounded = {name: None if value is None else round(value, _FIGURE_DIGITS) for name, value in figures_now}
            document = {"pose": pose, **rounded}
            parts += _member(f"{key}.json", json.dumps(document).encode())
        self.write(b"".join(parts))

    def finish(self) -> str:
        """Write the end of the tar; its SHA-256, hexadecimal. Raises OSError."""
        end = self.tell() + 2 * _BLOCK
        self.write(bytes(2 * _BLOCK + -end % _RECORD))
        self.flush()
        return self.sha256


def npy_head(frame: PixelArray) -> bytes:
    """What comes before the pixels of a frame in a .npy file."""
    file = io.BytesIO()
    described = {"descr": frame.dtype.str, "fortran_order": False, "shape": frame.shape}
    np.lib.format.write_array_header_1_0(file, described)
    return file.getvalue()


def _member(name: str, *parts: bytes | memoryview) -> list[bytes | memoryview]:
    size = sum(map(len, parts))
    return [_header(name, size), *parts, bytes(-size % _BLOCK)]


def _fields(name: bytes, size: bytes, checksum: bytes) -> bytes:
    """A header of POSIX.1-1988 (ustar): a file of mode 644, of nobody, from 1970."""
    return b"".join(
        (
            name.ljust(100, b"\0"),
            b"0000644\0",
            b"0000000\0" * 2,
            size,
            b"00000000000\0",
            checksum,
            b"0",
            bytes(100),
            b"ustar\00000",
            bytes(247),
        )
    )


_EMPTY_SUM = sum(_fields(b"", bytes(12), b" " * 8))


def _header(name: str, size: int) -> bytes:
    written, octal = name.encode("ascii"), b"%011o\0" % size
    if len(written) > 100 or size > _MAX_MEMBER:
        raise InvalidArgument(f"a shard holds no member of {size:,} bytes called {name}", field="outputs")
    return _fields(written, octal, b"%06o\0 " % (_EMPTY_SUM + sum(written) + sum(octal)))


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
        if plan.sampler is not None:
            assess = assess_by_rendering(self._scene, settings, assess, backend=self._backend, limits=self._limits)
        poses, extrapolations = plan.poses_of(shard, self._header.training_poses, settings.probe, assess)
        header = ExportHeader(settings, plan.dtype, poses, plan.scene, plan.scene_sha256, self.renderer)
        done = 0
        with ShardTar(path) as tar:

            def write(frames: dict[str, PixelArray], figures: list[Extrapolation]) -> None:
                nonlocal done
                stored = {name: stored_pixels(name, pixels, header.pixel_type(name)) for name, pixels in frames.items()}
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
                    in_bytes=plan.dtype == "uint8",
                ):
                    later(frames, figures)
            digest = tar.finish()
        return ShardEntry(
            file=plan.file_name(shard),
            first=numbers.start,
            frames=len(numbers),
            bytes=tar.tell(),
            sha256=digest,
            renderer=self.renderer,
            plan=plan.identity,
        )

    def _assess(self, look_up: Callable[[int], object], poses: FloatArray) -> list[Extrapolation]:
        """How far poses extrapolate, some at a time, so that a stop comes soon."""
        at_once = max(1, ASSESSED_AT_ONCE // max(1, len(self._header.training_poses)))
        extrapolations: list[Extrapolation] = []
        for first in range(0, len(poses), at_once):
            look_up(0)
            some, settings = poses[first : first + at_once], self._settings
            extrapolations.extend(self._assessor.assess(some, probe=settings.probe, phase=settings.phase))
        return extrapolations


ASSESSED_AT_ONCE = 100_000  # poses times training poses, of about a tenth of a second

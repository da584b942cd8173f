"""Rendering the poses of a file into one file or a folder of PNGs, in portions that fit in memory."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ultragray.confidence import CONTACT_SHARE, Assessor, Extrapolation, figure_arrays
from ultragray.errors import InvalidArgument, InvalidProbe
from ultragray.files.atomic import file_sha256
from ultragray.files.poses import load_poses
from ultragray.probe import FloatArray
from ultragray.samplers import Sampler, TrainingSampler, assessed_poses
from ultragray.scene_info import read_header
from ultragray.settings import Encoding, FrameSettings, Resolved
from ultragray_service.cli.progress import counted
from ultragray_service.cli.style import frames_in_words


@dataclass(frozen=True)
class Task:
    """Frames that are to be rendered, checked without a renderer."""

    scene_file: Path
    settings: Resolved
    poses: FloatArray  # [C, 4, 4] mm
    extrapolations: Sequence[Extrapolation]  # [C]

    @classmethod
    def prepared(cls, scene_file: Path, pose_file: Path | None, sampler: Sampler | None, asked: FrameSettings) -> Task:
        """The task of a command line. Raises InvalidArgument and its kind, SceneFileInvalid."""
        given_poses = None if pose_file is None else load_poses(pose_file)
        header = read_header(scene_file)
        try:
            settings = asked.resolved(header.info, Encoding.FLOAT32)
        except InvalidProbe as error:
            raise InvalidProbe(f"--{error.detail}", field="probe") from None  # as the option is called here
        base = header.training_poses if given_poses is None else given_poses
        if not len(base):
            raise InvalidArgument("--poses must be given: the scene holds no training poses", field="poses")
        if sampler is None and given_poses is None:
            sampler = TrainingSampler()
        assess = partial(Assessor(header.info, header.training_poses).assess, probe=settings.probe)
        return cls(scene_file, settings, *assessed_poses(sampler, base, settings.probe, assess, asked.least_confidence))


@dataclass(frozen=True)
class Rendered:
    """What a rendering wrote, how long it took, and how far it can be trusted."""

    output: Path
    settings: Resolved
    extrapolations: Sequence[Extrapolation]
    seconds: float

    def in_words(self) -> str:
        """One sentence."""
        size = f"{self.settings.height}x{self.settings.width}"
        what = f"{frames_in_words(len(self.extrapolations))} of {size}, {', '.join(self.settings.outputs)}"
        return f"wrote {self.output}: {what}, in {self.seconds:.1f} s; {_trust(self.extrapolations)}"

    def document(self) -> dict[str, Any]:
        """The same for a program."""
        figures = figure_arrays(self.extrapolations)
        confidence = figures["confidence"]
        known = bool(np.isfinite(confidence).all())
        return {
            "output": str(self.output),
            "frames": len(self.extrapolations),
            "height": self.settings.height,
            "width": self.settings.width,
            "outputs": list(self.settings.outputs),
            "seconds": round(self.seconds, 3),
            "confidence_min": float(confidence.min()) if known else None,
            "confidence_max": float(confidence.max()) if known else None,
            "supported_share": float(figures["supported_share"].mean()),
            **({CONTACT_SHARE: float(figures[CONTACT_SHARE].mean())} if CONTACT_SHARE in figures else {}),
        }


def render_frames(
    task: Task, output: Path, format: str | None, *, dtype: str | None, backend: str, threads: int
) -> Rendered:
    """Render and write; `format` None writes a folder of PNGs.

    Raises InvalidArgument, SceneFileInvalid, BackendUnavailable, MemoryExceeded, OSError; a file is then not written.
    """
    import torch

    from ultragray.exchange.rendering import render_to_file
    from ultragray.scene import GaussianScene
    from ultragray_workers.pool.process.placement import render_device

    scene = GaussianScene.load(task.scene_file)
    if threads:
        torch.set_num_threads(threads)
    started = time.perf_counter()
    with counted("rendering", len(task.poses)) as report:
        found = render_to_file(
            output,
            format,
            scene.to(render_device(backend)),
            task.settings,
            task.poses,
            task.extrapolations,
            dtype=dtype,
            scene_name=task.scene_file.stem,
            scene_sha256=file_sha256(task.scene_file),
            backend=backend,
            before_portion=report,
        )
    return Rendered(output, task.settings, found, time.perf_counter() - started)


def _trust(found: Sequence[Extrapolation]) -> str:
    """A few words on the confidence, where it is known, and on how much of the frames has support."""
    figures = figure_arrays(found)
    confidence = figures["confidence"]
    words = [f"Gaussians support {figures['supported_share'].mean():.0%} of the pixels"]
    if CONTACT_SHARE in figures:
        words.append(f"{figures[CONTACT_SHARE].mean():.0%} of the scan lines have contact")
    if np.isfinite(confidence).all():
        words.insert(0, f"confidence {confidence.min():.2f} to {confidence.max():.2f}")
    return ", ".join(words)

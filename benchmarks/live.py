"""How soon a scene that grows while it is scanned shows what the probe has seen, and how well in the end: `make live`.

Frames of a recorded sweep arrive at 10 Hz; what a worker does with them is `jobs.kinds.live_run`, as it is, on one
thread: on two cores a worker has one, the service the other. The clock is the processor time of that thread, so that
figures do not tell what else the machine had to do. Every fifth frame, from the third, is held out, of the live scene
as of `fast`, which is trained from the same frames afterwards.
"""

from __future__ import annotations

import os
import tempfile
import time
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from measuring import Document, Lines, columns, measure_runs
from ultragray.datasets.source import load_dataset
from ultragray.learn.evaluation.baselines import evaluate_baselines
from ultragray.learn.evaluation.metrics import frame_metrics
from ultragray.learn.evaluation.scoring import rendered_parts
from ultragray.learn.sweep import HELD_OUT_START, HELD_OUT_STEP, Dataset, Sweep, split_sequence
from ultragray.learn.training import TrainingConfig, train
from ultragray.learn.training.confidence import path_mm
from ultragray.learn.training.poses import PoseRefinement
from ultragray.scene.gaussians import GaussianScene
from ultragray_workers.datasets.recording import RecordedFrame, RecordingSettings
from ultragray_workers.datasets.store import open_datasets
from ultragray_workers.jobs.folder import JobFolder, Request
from ultragray_workers.jobs.kinds import live_run
from ultragray_workers.jobs.kinds.live import LiveJob
from ultragray_workers.jobs.worker.job_run import JobRun

RATE_HZ = 10.0
KILLS = 3
WITHIN_S, END_S = 3.0, 20.0
_Following, _Live = live_run.Following, live_run._Live  # as the product has them
SETS = ("spine_phantom", "ultranerf_liver", "nwire_phantom", "liver_convex")


@dataclass
class Clock:
    """The processor time since the first frame; waiting moves it on."""

    waited_s: float = 0.0
    begun_s: float = field(default_factory=time.process_time)

    def monotonic(self) -> float:
        """In place of time.monotonic."""
        return time.process_time() - self.begun_s + self.waited_s

    def sleep(self, seconds: float) -> None:
        """In place of time.sleep."""
        self.waited_s += seconds


@dataclass(frozen=True, eq=False)
class Version:
    """A scene that was served, and when."""

    at_s: float
    scene: GaussianScene


def followed(sweep: Sweep, kills: int) -> list[Version]:
    """The versions that a worker serves of a sweep; its process is killed so often, evenly over the sweep."""
    versions: list[Version] = []
    clock = Clock()
    with tempfile.TemporaryDirectory() as name:
        datasets = open_datasets(name, name)
        datasets.recordings.begin("sweep", RecordingSettings(sweep.probe, sweep.height, sweep.width))
        writer = datasets.recordings.writer("sweep")
        arrived = 0
        kills_at = [round((kill + 1) * len(sweep) / (kills + 1)) for kill in range(kills)]

        class Killed(BaseException):
            """As SIGKILL would, it leaves the process no time."""

        class Following(_Following):
            """Frames are stored when they are due."""

            def next(self, most: int = live_run.MOST_FRAMES) -> Any:
                nonlocal arrived
                due = min(len(sweep), int(clock.monotonic() * RATE_HZ) + 1)
                if due > arrived:
                    frames = [
                        RecordedFrame(n, n / RATE_HZ, sweep.poses[n], sweep.images[n]) for n in range(arrived, due)
                    ]
                    writer.append(frames)
                    arrived = due
                if kills_at and arrived >= kills_at[0]:
                    kills_at.pop(0)
                    raise Killed
                update = super().next(most)
                if update is None and arrived == len(sweep) and self.dataset is None:
                    self.dataset = Dataset("sweep", *split_sequence(sweep, len(sweep), None, None))
                    update = super().next(most)
                return update

        class Live(_Live):
            """Notes what it serves."""

            def publish(self, scene: GaussianScene) -> None:
                super().publish(scene)
                versions.append(Version(clock.monotonic(), scene))

        live_run.time, live_run.Following = clock, Following  # type: ignore[attr-defined, misc, assignment]
        folder = JobFolder(Path(name), "0" * 24)
        folder.make()
        request = Request({}, 1, None, None, "cpu", 1, 0, name, name)
        job = LiveJob(recording="sweep", scene="sweep-live")
        while True:
            try:
                live = Live(JobRun(folder, request, lambda: False), job, datasets)
                live.follow()
                live.settle()
                return versions
            except Killed:
                continue


def psnrs_db(scene: GaussianScene, recorded: Sweep, on_path: Sweep) -> np.ndarray:  # [F]
    """PSNR of a scene on held-out frames: at the poses of the path that it was trained on, as that of `fast` is; of a
    scene that took poses as they came at those.
    """
    values: list[float] = []
    sweep = recorded if scene.rest_poses is None and scene.pose_corrections is None else on_path
    for some, frames in rendered_parts(scene.at_rest(), sweep, ("bmode",), "auto"):
        truth = torch.from_numpy(some.images).float().div_(255.0)
        values += [one.psnr_db for one in frame_metrics(frames["bmode"].float(), truth)]
    return np.array(values)


def run(name: str, data_folder: Path) -> Document:
    """One set: with and without kills, beside `fast` and linear interpolation."""
    sweep = load_dataset(str(data_folder / name)).train
    load = os.getloadavg()[0]
    part = Dataset(name, *split_sequence(sweep, len(sweep), None, None))
    linear = np.array([one.psnr_db for one in evaluate_baselines(part, ("linear",), 1.0)["linear"].frames])
    arrivals_s = np.arange(HELD_OUT_START, len(sweep), HELD_OUT_STEP) / RATE_HZ
    frames = part.val, PoseRefinement.of(part, "path").dataset.val
    versions = followed(sweep, 0)
    scores_db = np.stack([psnrs_db(one.scene, *frames) for one in versions])  # [V, F]
    times_s = np.array([one.at_s for one in versions])
    waits_s = []
    for place, arrival_s in enumerate(arrivals_s):
        good = times_s[(scores_db[:, place] >= linear[place]) & (times_s >= arrival_s)]
        waits_s.append(float(good[0] - arrival_s) if len(good) else None)
    known = [wait_s for wait_s in waits_s if wait_s is not None]
    back = [0.0]
    for before, after, at_s in zip(scores_db, scores_db[1:], times_s, strict=False):
        if (there := arrivals_s <= at_s).any():
            back.append(float((before - after)[there].mean()))
    killed = followed(sweep, KILLS)
    begun_s = time.process_time()
    fast = train(part, TrainingConfig(confidence=False))
    end_s = (len(sweep) - 1) / RATE_HZ + END_S
    at_end = [place for place, at_s in enumerate(times_s) if at_s <= end_s][-1]
    return {
        "frames": len(sweep),
        "image": f"{sweep.height}x{sweep.width}",
        "path_mm": float(np.ptp(path_mm(sweep))),
        "load": [load, os.getloadavg()[0]],
        "linear_db": float(linear.mean()),
        "fast_db": float(fast.info.metrics["psnr_db"]),
        "fast_s": time.process_time() - begun_s,
        "live_db": float(scores_db[at_end].mean()),
        "killed_db": float(psnrs_db(killed[-1].scene, *frames).mean()),
        "settled_after_s": float(times_s[-1] - (len(sweep) - 1) / RATE_HZ),
        "versions": len(versions),
        "back_db": max(back),
        "wait_median_s": float(np.median(known)) if known else None,
        "within": sum(wait_s <= WITHIN_S for wait_s in known),
        "held_out": len(arrivals_s),
        "gaussians": versions[-1].scene.gaussian_count,
    }


def live_scenes(document: Document) -> Lines:
    """The table of the documents."""
    rows = [{"name": name, **of} for name, of in document.items()]
    yield from columns(
        rows,
        {
            "sweep": "{name}, {frames} frames of {image}",
            "as good as linear, after": "{wait_median_s:.1f} s",
            f"within {WITHIN_S:g} s": "{within} of {held_out}",
            "linear, dB": "{linear_db:.2f}",
            f"live, {END_S:g} s after the end": "{live_db:.2f}",
            f"killed {KILLS} times": "{killed_db:.2f}",
            "`fast`": "{fast_db:.2f}, {fast_s:.0f} s",
            "versions": "{versions}",
            "farthest back, dB": "{back_db:.2f}",
        },
    )


if __name__ == "__main__":
    measure_runs("live", __doc__, {name: partial(run, name) for name in SETS}, threads=1, at_once=2)

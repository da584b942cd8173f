"""The work of a live job: it follows a recording, lets a scene grow, serves its versions, then trains as `fast` does.

A process that is killed goes on from its last checkpoint, and reads the frames after it from the recording again.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace
from functools import partial

import numpy as np

from ultragray.files import write_whole
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.learn.sweep import ByteArray, Dataset, in_recorded_order
from ultragray.learn.training.growing import LOST_DB, GrowingTrainer
from ultragray.learn.training.trainer import CHECKPOINT_FILE
from ultragray.scene.gaussians import GaussianScene
from ultragray_workers.datasets.store import DatasetStore, open_datasets
from ultragray_workers.errors import DatasetNotFound, StorageUnavailable
from ultragray_workers.jobs.kinds import train_run
from ultragray_workers.jobs.kinds.live import LiveJob
from ultragray_workers.jobs.kinds.train import TrainJob
from ultragray_workers.jobs.progress import Outcome, Progress
from ultragray_workers.jobs.worker.job_run import JobRun, Stopped
from ultragray_workers.scene_names import SUFFIX
from ultragray_workers.scene_shelf import SCENES_FOLDER, SceneShelf
from ultragray_workers.storage.location import open_storage

CHECKPOINT, JUDGED = "live.safetensors", "judged.json"  # of the folder of the run: the latter of what is served
CHECKPOINT_EVERY_S = 5.0
STEPS_A_VERSION = 4.0  # times as long as it takes to judge and serve one
POLL_S = 0.1  # while nothing is to be done but to wait for frames
LOOK_EVERY_S = 0.25  # for new frames: each question to a storage elsewhere takes its time, and so does each addition
PAUSE_STEPS = 150  # after which a sweep that goes no further is learned; they become ever smaller
SETTLE_S, LEAST_SETTLE_S = 18.0, 5.0  # after the last frame, for the whole sweep at once; of them steps at least
SETTLING_RATE = 2.0  # of the first of them: they are few
SETTLING_VERSION_S = 0.75  # of them, before the first version, and three times as long before each further one
MOST_FRAMES = 32  # taken from the recording before the next step


class Following:
    """The frames of a recording in their order, as they come, and then those of the data set that it has become."""

    def __init__(self, datasets: DatasetStore, name: str) -> None:
        """Raises DatasetNotFound where there is neither."""
        self._datasets, self._name = datasets, name
        self.dataset: Dataset | None = None  # once the recording is finished
        self._blocks = self._taken = 0
        self._looked_at_s = float("-inf")
        self.probe = self._begin()

    def _begin(self) -> Probe:
        try:
            return self._datasets.recordings.settings(self._name).probe
        except DatasetNotFound:
            self._finish()
            assert self.dataset is not None
            return self.dataset.probe

    def next(self, most: int = MOST_FRAMES) -> tuple[ByteArray, FloatArray] | None:  # [F, H, W], [F, 4, 4] mm
        """Frames that have come since the last call, at most about so many; None where there are none.

        Raises DatasetNotFound where the recording was deleted.
        """
        if self.dataset is not None:
            return self._rest(most)
        now_s = time.monotonic()
        if now_s - self._looked_at_s < LOOK_EVERY_S:
            return None
        self._looked_at_s = now_s
        frames = []
        try:
            for block in self._datasets.recordings.frames(self._name, self._blocks):
                frames += block
                self._blocks += 1
                if len(frames) >= most:
                    break
        except DatasetNotFound:  # it has become a data set, or is gone
            self._finish()
            return self._rest(most)
        if not frames:
            return None
        self._taken += len(frames)
        return np.stack([one.pixels for one in frames]), np.stack([one.pose for one in frames])

    def _finish(self) -> None:
        self.dataset = self._datasets.load(self._name)

    def _rest(self, most: int) -> tuple[ByteArray, FloatArray] | None:
        assert self.dataset is not None
        images, poses = in_recorded_order(self.dataset)
        first, self._taken = self._taken, min(len(images), self._taken + most)
        return (images[first : self._taken], poses[first : self._taken]) if first < self._taken else None


class _Live:
    """One process at a live job, until the recording is finished and its scene has settled."""

    def __init__(self, job_run: JobRun, job: LiveJob, datasets: DatasetStore) -> None:
        self._run, self._job = job_run, job
        self.following = Following(datasets, job.recording)
        self._shelf = SceneShelf(open_storage(job_run.request.storage), SCENES_FOLDER)
        self._checkpoint = job_run.folder.run / CHECKPOINT
        self._judged = job_run.folder.run / JUDGED
        self._file = job_run.folder.path / f"version{SUFFIX}"
        self.trainer = GrowingTrainer(job.recording, self.following.probe, device=job_run.request.device)
        self._saved_at_s = self._served_at_s = time.monotonic()
        self._steps_at_last_frame = self._served_step = 0
        self._steps_per_s = self._serving_s = 0.0
        self.scene: GaussianScene | None = None  # the version that is served
        self._restore()

    def follow(self) -> None:
        """Learns until the last frame has come. Raises Stopped."""
        while True:
            frames = self._run.patiently(self.following.next, StorageUnavailable)
            if frames is not None:
                self.trainer.add(*frames)
                self._steps_at_last_frame = self.trainer.step
            elif self.following.dataset is not None:
                return
            since = self.trainer.step - self._steps_at_last_frame
            if since >= PAUSE_STEPS and frames is None:
                time.sleep(POLL_S)
            else:
                self._take_step(0.1 ** (since / PAUSE_STEPS))
            self._serve_now_and_then()
            self._tell()

    def settle(self) -> None:
        """Serves the scene as the last frame leaves it, then learns the whole sweep anew for a while, in steps that
        become ever smaller, and serves what that comes to on the way. Raises Stopped.

        Nothing where the data set holds out other frames than a recording does: what the trainer judged by is not that.
        """
        dataset, trainer = self.following.dataset, self.trainer
        if not trainer.is_growing or dataset is None or not len(dataset.val):
            return
        if trainer.frame_count != len(dataset.train) + len(dataset.val):
            return
        end_s, version_s = time.monotonic() + SETTLE_S, SETTLING_VERSION_S
        self._serve_if_as_good(trainer)
        settled = trainer.anew(dataset)
        begun_s = time.monotonic()
        while (share := (time.monotonic() - begun_s) / max(end_s - begun_s, LEAST_SETTLE_S)) < 1.0:
            settled.take_step(SETTLING_RATE * 0.1**share)
            if time.monotonic() - begun_s >= version_s:
                self._serve_if_as_good(settled)
                version_s *= 3.0
            self._tell()
        self.trainer = settled
        self.serve()

    def serve(self) -> bool:
        """Whether the scene as it is is served; where it has become worse, it goes on in smaller steps instead."""
        begun_s = time.monotonic()
        is_served = self._serve_if_as_good(self.trainer)
        if not is_served:
            self.trainer.slow_down()
        self._served_at_s, self._served_step = time.monotonic(), self.trainer.step
        self._serving_s = self._served_at_s - begun_s
        return is_served

    def _serve_if_as_good(self, trainer: GrowingTrainer) -> bool:
        """Whether its scene is served: the version before is not better."""
        judgement = trainer.judge()
        if trainer.is_worse(judgement):
            sys.stderr.write(f"step {trainer.step:,}: not served, for the version before is better\n")
            return False
        self.scene = trainer.scene(judgement)
        self.publish(self.scene)
        trainer.accept(judgement)
        self._judged.parent.mkdir(parents=True, exist_ok=True)
        write_whole(self._judged, json.dumps(trainer.judged))
        self._run.progress = replace(self._run.progress, val_psnr_db=judgement.mean_psnr_db)
        held_out = "" if judgement.mean_psnr_db is None else f", held out {judgement.mean_psnr_db:.2f} dB"
        sys.stderr.write(
            f"step {trainer.step:,}, frame {trainer.frame_count:,}: a version of "
            f"{trainer.gaussian_count:,} Gaussians is served{held_out}\n"
        )
        sys.stderr.flush()
        return True

    def publish(self, scene: GaussianScene) -> None:
        scene.save(self._file)
        self._run.patiently(lambda: self._shelf.replace(self._file, self._job.scene), StorageUnavailable)
        self._file.unlink()  # of a near storage it is a link to the scene

    def _take_step(self, rate: float = 1.0) -> None:
        if not self.trainer.is_growing:
            time.sleep(POLL_S)
            return
        begun_s = time.monotonic()
        self.trainer.take_step(rate)
        taken_s = time.monotonic() - begun_s
        self._steps_per_s = 0.9 * self._steps_per_s + 0.1 / max(taken_s, 1e-3) if self._steps_per_s else 1.0 / taken_s

    def _serve_now_and_then(self) -> None:
        now_s = time.monotonic()
        wait_s = max(self._job.version_every_s, STEPS_A_VERSION * self._serving_s)
        is_due = self.trainer.step > self._served_step and now_s - self._served_at_s >= wait_s
        is_served = is_due and self.serve()  # then it is saved, too: who goes on from there has nothing to make up for
        if self.trainer.is_growing and (is_served or now_s - self._saved_at_s >= CHECKPOINT_EVERY_S):
            self._save()

    def _tell(self) -> None:
        trainer, progress = self.trainer, self._run.progress
        self._run.report(
            Progress(
                phase="live",
                step=trainer.step,
                val_psnr_db=progress.val_psnr_db,
                gaussians=trainer.gaussian_count,
                frames_done=trainer.frame_count,
                rate_per_s=self._steps_per_s,
            )
        )
        if self._run.should_stop():
            if trainer.is_growing:
                self._save()
            raise Stopped

    def _save(self) -> None:
        self._checkpoint.parent.mkdir(parents=True, exist_ok=True)
        self.trainer.save(self._checkpoint)
        self._saved_at_s = time.monotonic()

    def _restore(self) -> None:
        """Goes on from the checkpoint that an earlier process left. Raises TrainingStateInvalid."""
        if self._judged.exists():  # no version is served that is worse than those before, whatever was lost with them
            self.trainer.judged = {int(place): of for place, of in json.loads(self._judged.read_text()).items()}
        if not self._checkpoint.exists():
            return
        count = GrowingTrainer.frames_of(self._checkpoint)
        parts: list[tuple[ByteArray, FloatArray]] = []
        while (missing := count - sum(len(images) for images, _ in parts)) > 0:
            part = self._run.patiently(partial(self.following.next, missing), StorageUnavailable)
            if part is not None:
                parts.append(part)
        images, poses = (np.concatenate(some) for some in zip(*parts, strict=True))
        self.trainer.restore(self._checkpoint, images, poses)
        self._steps_at_last_frame = self.trainer.step
        sys.stderr.write(f"going on from a checkpoint after step {self.trainer.step:,}, frame {count:,}\n")


def run(job_run: JobRun, job: LiveJob) -> Outcome:
    """Follows the recording to its end, then trains; the scene of the preset `fast` is served last, unless it is worse.

    Raises Stopped, DatasetNotFound where the recording is deleted, and what a training raises.
    """
    request = job_run.request
    datasets = open_datasets(job_run.folder.artifact_folder, request.storage, request.max_copies_bytes)
    live = _Live(job_run, job, datasets)
    live.follow()
    if not (job_run.folder.run / CHECKPOINT_FILE).exists():
        live.settle()
    training = TrainJob(dataset=job.recording, scene=job.scene, device=job.device)
    outcome = train_run.run(job_run, training, better=live.scene, by_db=LOST_DB)
    live.publish(GaussianScene.load(job_run.folder.artifacts / f"{job.scene}{SUFFIX}"))
    return outcome

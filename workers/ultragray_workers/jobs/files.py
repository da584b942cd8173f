"""The files of jobs as services read and remove them, wherever they are. Free of torch."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Protocol, TypeAlias

from ultragray_workers.jobs.folder import Progress
from ultragray_workers.jobs.shared.reading import SharedFile, SharedLog

Artifact: TypeAlias = Path | SharedFile
Log: TypeAlias = Path | SharedLog
# Of a run; `ultragray.learn.training`, which writes all but the last, imports torch.
JOURNAL_NAME, CHECKPOINT_NAME, CONFIG_NAME = "metrics.jsonl", "checkpoint.safetensors", "config.json"
BASELINES_NAME = "baselines.json"  # what classical methods reach, PSNR in dB by their names


def size_of_log(log: Log) -> int:
    """The bytes of a log; 0 where there is none yet. Raises StorageUnavailable."""
    if isinstance(log, SharedLog):
        return log.size()
    try:
        return log.stat().st_size
    except FileNotFoundError:
        return 0


def read_log(log: Log, start: int, length: int) -> bytes:
    """At most `length` bytes of a log from `start` on. Raises StorageUnavailable."""
    if isinstance(log, SharedLog):
        return log.read(start, length)
    try:
        with log.open("rb") as file:
            file.seek(start)
            return file.read(length)
    except FileNotFoundError:
        return b""


class JobFiles(Protocol):
    """Where the files of jobs are. Every method blocks, and raises StorageUnavailable where a storage is away."""

    def progress(self, job_id: str) -> Progress:
        """How far the job is, as far as it is known now. Raises nothing."""

    def log(self, job_id: str) -> Log:
        """The log of the job, there or not yet."""

    def artifacts(self, job_id: str) -> dict[str, Artifact]:
        """The files to download, by name; of a batch with its shards."""

    def artifact(self, job_id: str, name: str) -> Artifact | None:
        """One file to download, of the name that it is known to have; None where it has gone."""

    def text_of_run(self, job_id: str, name: str) -> str | None:
        """A file of a training, as the run has it so far, then as an artifact; None before it is there.

        The last line of the journal may be half written.
        """

    def checkpoint(self, job_id: str) -> contextlib.AbstractContextManager[tuple[Path, str] | None]:
        """The newest checkpoint of the training on this host, and a word that tells it from the next; None without."""

    def kept_scene(self, job_id: str, scene: str) -> contextlib.AbstractContextManager[Path | None]:
        """The scene as it was kept for the job, on this host; None where it was not."""

    def keep_scene(self, path: Path, scene: str, job_id: str) -> None:
        """Keeps a scene, as it is now, for a job that is submitted. Raises FileNotFoundError where it is gone."""

    def removed(self, job_id: str) -> contextlib.AbstractContextManager[None]:
        """Removes the files of a finished job; nobody finds them during the body.

        Raises JobInUse while a process of the job still ends. Where the body raises, a folder is as before; of a
        storage the files have gone.
        """

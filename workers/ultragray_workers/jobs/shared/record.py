"""The record of a job in a shared storage: the one small object that says what there is of the job.

jobs/ID/record.json        this record, replaced by conditional writes alone
jobs/ID/NAME.ugr           the scene that the job needs, as it was when the job was submitted
jobs/ID/WRITER/log-N       pieces of the log; the last of a writer grows
jobs/ID/WRITER/run-N/      a checkpoint, with the journal and the configuration of its training
jobs/ID/WRITER/artifacts/  what can be downloaded
jobs/ID/batch/             what can be downloaded of a job in shards, see `batches.place`: many workers write it

Objects of a writer count only where the record names them, so that a checkpoint is there whole or not at all. The
record belongs to the writer that it names, one attempt of one worker: a worker that was cut off, and comes back when
another one has gone on with the job, can change it no more. Free of torch.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from ultragray_workers.jobs.folder import BATCH, FOLDER, Outcome, Progress
from ultragray_workers.storage.storage import NotThere, Storage

FORMAT_VERSION = 1
RECORD_NAME = "record.json"


@dataclass(frozen=True)
class StoredFile:
    """A whole object."""

    key: str
    bytes: int
    sha256: str


@dataclass(frozen=True)
class LogPiece:
    """A part of the log: the first bytes of an object, which may have more already."""

    key: str
    bytes: int


@dataclass(frozen=True)
class JobRecord:
    """What there is of a job."""

    submission: str | None  # tells this submission of a request_id from an earlier one, whose database is lost
    attempt: int  # of the queue: a higher one comes later
    writer: str  # who may replace the record
    serial: int = 0  # of the writer's records, no two of which are the same
    progress: Progress = field(default_factory=Progress)
    log: tuple[LogPiece, ...] = ()
    run: Mapping[str, StoredFile] = field(default_factory=dict)  # the newest checkpoint, by the names of its files
    artifacts: Mapping[str, StoredFile] = field(default_factory=dict)
    outcome: Outcome | None = None

    @property
    def log_bytes(self) -> int:
        """The length of the log."""
        return sum(piece.bytes for piece in self.log)

    def keys(self) -> set[str]:
        """The objects that it names."""
        files = {one.key for one in (*self.run.values(), *self.artifacts.values())}
        return files | {piece.key for piece in self.log}

    def to_json(self) -> bytes:
        """The content of the object."""
        values = {**asdict(self), "outcome": None if self.outcome is None else self.outcome.to_dict()}
        return json.dumps({"format_version": FORMAT_VERSION, **values}).encode()

    @classmethod
    def from_json(cls, data: bytes) -> JobRecord:
        """Inverse of `to_json`. Raises ValueError, KeyError or TypeError for anything else."""
        document: dict[str, Any] = json.loads(data)
        version = document.pop("format_version")
        if version != FORMAT_VERSION:
            raise ValueError(f"it has version {version!r}, this release knows {FORMAT_VERSION}")
        return cls(
            **{
                **document,
                "progress": Progress.from_dict(document["progress"]),
                "log": tuple(LogPiece(**piece) for piece in document["log"]),
                **{
                    name: {one: StoredFile(**file) for one, file in document[name].items()}
                    for name in ("run", "artifacts")
                },
                "outcome": None if document["outcome"] is None else Outcome.from_dict(document["outcome"]),
            }
        )


class Superseded(Exception):
    """Another worker goes on with the job: this one must not write anything of it any more."""


def prefix_of(job_id: str) -> str:
    """The prefix of the keys of a job."""
    return f"{FOLDER}/{job_id}"


def batch_prefix_of(job_id: str) -> str:
    """The prefix of the keys of a job's shards."""
    return f"{prefix_of(job_id)}/{BATCH}"


def record_key(job_id: str) -> str:
    """The key of the record of a job."""
    return f"{prefix_of(job_id)}/{RECORD_NAME}"


def read_record(storage: Storage, job_id: str) -> JobRecord | None:
    """The record of a job; None where there is none, or none that this release can read. Raises StorageUnavailable."""
    try:
        return JobRecord.from_json(storage.read(record_key(job_id)))
    except (NotThere, ValueError, KeyError, TypeError):
        return None


def claim(storage: Storage, job_id: str, submission: str | None, attempt: int) -> JobRecord:
    """Makes the record a new writer's, which goes on from what was there of the same submission.

    Raises Superseded where a later attempt has claimed it, StorageUnavailable.
    """
    while True:
        entry = storage.entry(record_key(job_id))  # before it is read: a change in between fails the write
        before = None if entry is None else read_record(storage, job_id)
        mine = JobRecord(submission, attempt, secrets.token_hex(8))
        if before is not None and before.submission == submission:
            if before.attempt > attempt:
                raise Superseded
            mine = replace(before, attempt=attempt, writer=mine.writer, serial=0)
        condition: dict[str, Any] = {"if_absent": True} if entry is None else {"if_version": entry.version}
        if storage.write(record_key(job_id), mine.to_json(), **condition):
            return mine


def change(storage: Storage, job_id: str, writer: str, changed: Callable[[JobRecord], JobRecord]) -> JobRecord:
    """Replaces the record by what `changed` makes of it. Raises Superseded where it is not the writer's any more,
    StorageUnavailable.
    """
    while True:
        entry = storage.entry(record_key(job_id))
        before = None if entry is None else read_record(storage, job_id)
        if entry is None or before is None or before.writer != writer:
            raise Superseded
        after = replace(changed(before), serial=before.serial + 1)
        if storage.write(record_key(job_id), after.to_json(), if_version=entry.version):
            return after

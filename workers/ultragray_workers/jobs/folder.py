"""The folder of one job, which its worker and its training process write and the service reads.

job.json        what is asked for: written by the worker before its process starts
lock            held by the one process that works in the folder, whose number it says
NAME.ugr        the scene that the job needs, as it was when the job was submitted
run/            the trainer's folder: checkpoint, journal, configuration; of a comparison one for each method within
progress.json   how far it is
log.txt         what the process said
reserve         room on the disk, given back when the process has ended
artifacts/      what can be downloaded; appears whole
batch/          of a job in shards: what can be downloaded instead, see `batches.place`; other hosts write to it, too
outcome.json    how it ended: the last thing that the process writes
scratch.partial files of a step that are not kept: see `JobFolder.scratch`
"""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar

from ultragray.contract import described
from ultragray.files import remove_stale_temporaries, sync, write_whole
from ultragray_workers.datasets.copies import DEFAULT_MAX_BYTES

FOLDER, BATCH = "jobs", "batch"
PHASES = ("baselines", "effort", "training", "evaluation", "confidence", "report")


@dataclass(frozen=True)
class Progress:
    """The progress of a job; null for what does not apply, or not yet."""

    __pydantic_config__: ClassVar[dict[str, Any]] = {"json_schema_serialization_defaults_required": True}

    step: int | None = described("Steps that are done of a training, or of the method at hand of a comparison.", None)
    steps: int | None = None
    loss: float | None = None
    val_psnr_db: float | None = described("On the held-out frames, the last time it was measured.", None)
    gaussians: int | None = None
    frames_done: int | None = described(
        "Frames that are done, such as those of a render job in its archive; of a volume: layers of voxels.", None
    )
    frames: int | None = None
    rate_per_s: float | None = described("Steps or frames.", None)
    seconds_left: float | None = described("Until the end of the job, of all that is still to be done; about.", None)
    waits_for: str | None = described(
        "Of a job that waits: what else it needs than its turn, such as a worker that offers what it asks for.", None
    )
    method: str | None = described("Of a comparison: the method at hand.", None)
    method_number: int | None = described("Its number among the methods of the comparison, from 1.", None)
    methods: int | None = None
    phase: str | None = described(
        "Of a training that runs: classical methods are measured, the effort is chosen, it trains, it is measured on "
        "the held-out frames, its confidence is fitted, or its report is written.",
        None,
        choices=PHASES,
    )

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> Progress:
        """Inverse of `asdict`; unknown keys, of a later release, are left out."""
        return cls(**{item.name: document.get(item.name) for item in fields(cls)})


@dataclass(frozen=True)
class Outcome:
    """The end of a job's work: artifacts, or a reason."""

    error: str | None = None  # stable reason, such as DATASET_INVALID; None: it succeeded
    reason: str | None = None  # one sentence
    artifacts: tuple[str, ...] = ()
    metrics: dict[str, float] = field(default_factory=dict)
    progress: Progress = Progress()
    attempts: int = 1  # how often a process was started for it

    def to_dict(self) -> dict[str, Any]:
        """The outcome as JSON holds it."""
        return {**asdict(self), "artifacts": list(self.artifacts)}

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> Outcome:
        """Inverse of `to_dict`."""
        values = {item.name: document[item.name] for item in fields(cls) if item.name in document}
        values["artifacts"] = tuple(values.get("artifacts", ()))
        values["progress"] = Progress.from_dict(values.get("progress", {}))
        return cls(**values)


@dataclass(frozen=True)
class Request:
    """The instructions of a worker to the process of a job."""

    specification: dict[str, Any]
    retry_of: str | None
    submission: str | None  # tells this submission of a request_id from an earlier one, whose database is lost
    device: str  # cpu, cuda or cuda:N
    threads: int
    nice: int
    max_footprint_pixels: int | None = None  # of a frame, see ultragray.rendering.limits; None: no limit
    storage: str | None = None  # that several hosts share; None: all is in the artifact folder
    max_copies_bytes: int = DEFAULT_MAX_BYTES  # of shared datasets on this host


class JobFolder:
    """The paths of one job, and its small files."""

    def __init__(self, artifact_folder: Path, job_id: str) -> None:
        self.artifact_folder, self.job_id = Path(artifact_folder), job_id
        self.path = self.artifact_folder / FOLDER / job_id
        self.lock = self.path / "lock"
        self.run = self.path / "run"
        self.log = self.path / "log.txt"
        self.reserve = self.path / "reserve"
        self.artifacts = self.path / "artifacts"
        self.batch = self.path / BATCH
        self._partial = self.path / "artifacts.partial"
        self._scratch = self.path / "scratch.partial"
        self._request = self.path / "job.json"
        self._progress = self.path / "progress.json"
        self._outcome = self.path / "outcome.json"

    def request(self) -> Request:
        """The worker's instructions. Raises OSError, ValueError."""
        return Request(**json.loads(self._request.read_text(encoding="utf-8")))

    def begin(self, submission: str | None, needed: str | None) -> None:
        """Makes the folder; empties that of another submission, but for the file that this one needs.

        A job's id follows from its request_id: after its database was lost, another job of that id may have been here.
        Raises OSError.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        before = _read(self._request)
        if before is None or before.get("submission") == submission:
            return
        for path in self.path.iterdir():
            if path == self._request or path.name in (self.lock.name, needed):
                continue
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
        self._request.unlink()  # last: until then the folder is the other one's

    def was_begun(self) -> bool:
        """True where a worker has started a process in the folder."""
        return self._request.exists()

    def write_request(self, request: Request) -> None:
        """Replaces the file whole. Raises OSError."""
        _write(self._request, asdict(request))

    def progress(self) -> Progress:
        """The progress of the job, as far as its folder says."""
        document = _read(self._progress)
        return Progress() if document is None else Progress.from_dict(document)

    def write_progress(self, progress: Progress) -> None:
        """Replaces the file whole. Raises OSError."""
        _write(self._progress, asdict(progress))

    def outcome(self) -> Outcome | None:
        """The end of the work; None where it goes on."""
        document = _read(self._outcome)
        return None if document is None else Outcome.from_dict(document)

    def write_outcome(self, outcome: Outcome) -> None:
        """Replaces the file whole. Raises OSError."""
        _write(self._outcome, outcome.to_dict())

    @contextlib.contextmanager
    def new_artifacts(self) -> Iterator[Path]:
        """An empty folder for the artifacts, which becomes `artifacts` at the end; nothing where the body raises."""
        shutil.rmtree(self._partial, ignore_errors=True)
        shutil.rmtree(self.artifacts, ignore_errors=True)  # of a process that died before it wrote its outcome
        self._partial.mkdir()
        try:
            yield self._partial
            for path in self._partial.iterdir():
                sync(path)
            sync(self._partial)
            self._partial.rename(self.artifacts)
            sync(self.path)
        finally:
            shutil.rmtree(self._partial, ignore_errors=True)

    @contextlib.contextmanager
    def scratch(self) -> Iterator[Path]:
        """An empty folder for what is not kept, removed after the body. One at a time."""
        shutil.rmtree(self._scratch, ignore_errors=True)
        self._scratch.mkdir()
        try:
            yield self._scratch
        finally:
            shutil.rmtree(self._scratch, ignore_errors=True)

    def remove_leftovers(self) -> None:
        """Removes the half written files of killed processes; no process may be at the job meanwhile."""
        shutil.rmtree(self._partial, ignore_errors=True)
        shutil.rmtree(self._scratch, ignore_errors=True)
        with contextlib.suppress(OSError):
            self.reserve.unlink(missing_ok=True)
            for path in (self._request, self._progress, self._outcome):
                remove_stale_temporaries(path)

    def artifact_names(self) -> tuple[str, ...]:
        """The files to download, sorted."""
        return tuple(sorted(path.name for path in self.artifacts.iterdir()))

    def remove_checkpoints(self) -> None:
        """Removes what only an unfinished job needs."""
        shutil.rmtree(self.run, ignore_errors=True)


def _read(path: Path) -> dict[str, Any] | None:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return document if isinstance(document, dict) else None


def _write(path: Path, document: Mapping[str, Any]) -> None:
    write_whole(path, json.dumps(document) + "\n")

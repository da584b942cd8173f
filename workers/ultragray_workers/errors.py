"""The errors of the render pool, the datasets and the jobs: a part of the tree of `ultragray.errors`."""

from __future__ import annotations

from collections.abc import Sequence

from ultragray.errors import UltragrayError

_NAMES_IN_MESSAGE = 5


class SceneNotFound(UltragrayError, title="No such scene"):
    """No scene of that name."""


class RegistrationNotFound(UltragrayError, title="No such registration"):
    """No registration of that name."""


class DatasetNotFound(UltragrayError, title="No such dataset"):
    """No dataset of that name."""


class DatasetExists(UltragrayError, title="Another dataset has that name"):
    """A dataset of that name has another content or other options; delete it first."""


class RecordingTaken(UltragrayError, title="Somebody else records there"):
    """Two record into one recording at a time; one may."""


class DatasetInUse(UltragrayError, title="Dataset in use"):
    """A job needs the dataset."""


class UploadTooLarge(UltragrayError, title="Upload too large"):
    """An upload over `ULTRAGRAY_MAX_DATASET_BYTES`, packed or unpacked, or of too many files."""


class StorageFull(UltragrayError, title="No room on the disk"):
    """The artifact folder has no room, or a render job would write more than it has room for."""


class StorageUnavailable(UltragrayError, title="The object storage cannot be used"):
    """The object storage does not answer, or refuses its credentials; what is cached is served all the same; retry."""


class SceneExists(UltragrayError, title="Scene already exists"):
    """A scene of that name is there, or a job is making it."""


class DatabaseUnavailable(UltragrayError, title="The database of the jobs cannot be used"):
    """The database of the jobs is away or takes no changes; scenes are rendered all the same; retry."""


class ArtifactFolderUnavailable(UltragrayError, title="The artifact folder is not there"):
    """The artifact folder is gone, or not the one that the jobs belong to: its share is not mounted; retry."""


class JobStalled(UltragrayError, title="The job got stuck"):
    """The process of a job neither computed nor read nor wrote for `ULTRAGRAY_JOB_STALL_TIMEOUT_S`, and was ended."""


class JobTimeExceeded(UltragrayError, title="The job took too long"):
    """A job ran longer than its `max_run_s`, or `ULTRAGRAY_JOB_MAX_RUN_S`, and was ended."""


class JobNotFound(UltragrayError, title="No such job"):
    """No job of that id."""


class JobConflict(UltragrayError, title="Request id used for another job", reason="REQUEST_ID_CONFLICT"):
    """The `request_id` was used for something else."""


class JobFinished(UltragrayError, title="Job is finished"):
    """A job that succeeded or failed cannot be cancelled."""


class JobNotFinished(UltragrayError, title="Job cannot be retried"):
    """Only a failed or cancelled job can be retried."""


class JobInUse(UltragrayError, title="Job in use"):
    """A job that waits or runs, or that another of those goes on from, cannot be deleted."""


class JobQueueFull(UltragrayError, title="Too many jobs are waiting"):
    """Too many jobs wait; retry."""


class WorkerNotFound(UltragrayError, title="No such worker"):
    """No worker of that name."""


class ArtifactNotFound(UltragrayError, title="No such artifact"):
    """The job has no file of that name."""


class SceneTooLarge(UltragrayError, title="Scene exceeds the memory budget"):
    """A scene that does not fit `ULTRAGRAY_MEMORY_BUDGET_MB` at all."""


class QueueFull(UltragrayError, title="Too much is waiting"):
    """Too many frames wait, or too many uploads are under way; retry."""


class DeadlineExceeded(UltragrayError, title="Deadline exceeded"):
    """The deadline passed first."""


class NotReady(UltragrayError, title="Service is not ready"):
    """The service is starting, or cannot render at the moment; retry."""


class Draining(UltragrayError, title="Service is stopping"):
    """The service is stopping; retry elsewhere."""


class BackupInvalid(UltragrayError, title="Backup cannot be used"):
    """A backup that is not there, damaged, or made by a newer release (command line)."""


class RestoreRefused(UltragrayError, title="Place of the backup or restore cannot be used"):
    """A backup or restore into a place that holds something else, or where somebody is at work (command line)."""


class StartupFailed(UltragrayError, title="Service cannot start"):
    """The service cannot start, such as on a port in use (command line)."""


def job_not_found(job_id: str) -> JobNotFound:
    """The error at a job that is not there, or that the caller may not see."""
    return JobNotFound(f"there is no job {job_id[:64]!r}", field="job")


def known_names(kind: str, names: Sequence[str]) -> str:
    """The scenes or datasets that there are, the first few by name, for the message that another is not there."""
    listing = ", ".join(names[:_NAMES_IN_MESSAGE]) + (", …" if len(names) > _NAMES_IN_MESSAGE else "")
    return f"known {kind}s: {listing}" if names else f"there are no {kind}s yet"

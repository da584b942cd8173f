"""The errors of the render pool, the datasets and the jobs: a part of the tree of `ultragray.errors`."""

from __future__ import annotations

from collections.abc import Sequence

from ultragray.errors import UltragrayError

_NAMES_IN_MESSAGE = 5


class SceneNotFound(UltragrayError):
    """No scene of that name."""

    title = "No such scene"


class RegistrationNotFound(UltragrayError):
    """No registration of that name."""

    title = "No such registration"


class DatasetNotFound(UltragrayError):
    """No dataset of that name."""

    title = "No such dataset"


class DatasetExists(UltragrayError):
    """A dataset of that name has another content or other options; delete it first."""

    title = "Another dataset has that name"


class DatasetInUse(UltragrayError):
    """A job needs the dataset."""

    title = "Dataset in use"


class UploadTooLarge(UltragrayError):
    """An upload over `ULTRAGRAY_MAX_DATASET_BYTES`, packed or unpacked, or of too many files."""

    title = "Upload too large"


class StorageFull(UltragrayError):
    """The artifact folder has no room, or a render job would write more than it has room for."""

    title = "No room on the disk"


class StorageUnavailable(UltragrayError):
    """The object storage does not answer, or refuses its credentials; what is cached is served all the same; retry."""

    title = "The object storage cannot be used"


class SceneExists(UltragrayError):
    """A scene of that name is there, or a job is making it."""

    title = "Scene already exists"


class DatabaseUnavailable(UltragrayError):
    """The database of the jobs is away or takes no changes; scenes are rendered all the same; retry."""

    title = "The database of the jobs cannot be used"


class ArtifactFolderUnavailable(UltragrayError):
    """The artifact folder is gone, or not the one that the jobs belong to: its share is not mounted; retry."""

    title = "The artifact folder is not there"


class JobStalled(UltragrayError):
    """The process of a job neither computed nor read nor wrote for `ULTRAGRAY_JOB_STALL_TIMEOUT_S`, and was ended."""

    title = "The job got stuck"


class JobTimeExceeded(UltragrayError):
    """A job ran longer than its `max_run_s`, or `ULTRAGRAY_JOB_MAX_RUN_S`, and was ended."""

    title = "The job took too long"


class JobNotFound(UltragrayError):
    """No job of that id."""

    title = "No such job"


class JobConflict(UltragrayError):
    """The `request_id` was used for something else."""

    reason = "REQUEST_ID_CONFLICT"
    title = "Request id used for another job"


class JobFinished(UltragrayError):
    """A job that succeeded or failed cannot be cancelled."""

    title = "Job is finished"


class JobNotFinished(UltragrayError):
    """Only a failed or cancelled job can be retried."""

    title = "Job cannot be retried"


class JobInUse(UltragrayError):
    """A job that waits or runs, or that another of those goes on from, cannot be deleted."""

    title = "Job in use"


class JobQueueFull(UltragrayError):
    """Too many jobs wait; retry."""

    title = "Too many jobs are waiting"


class WorkerNotFound(UltragrayError):
    """No worker of that name."""

    title = "No such worker"


class ArtifactNotFound(UltragrayError):
    """The job has no file of that name."""

    title = "No such artifact"


class SceneTooLarge(UltragrayError):
    """A scene that does not fit `ULTRAGRAY_MEMORY_BUDGET_MB` at all."""

    title = "Scene exceeds the memory budget"


class QueueFull(UltragrayError):
    """Too many frames wait, or too many uploads are under way; retry."""

    title = "Too much is waiting"


class DeadlineExceeded(UltragrayError):
    """The deadline passed first."""

    title = "Deadline exceeded"


class NotReady(UltragrayError):
    """The service is starting, or cannot render at the moment; retry."""

    title = "Service is not ready"


class Draining(UltragrayError):
    """The service is stopping; retry elsewhere."""

    title = "Service is stopping"


class BackupInvalid(UltragrayError):
    """A backup that is not there, damaged, or made by a newer release (command line)."""

    title = "Backup cannot be used"


class RestoreRefused(UltragrayError):
    """A backup or restore into a place that holds something else, or where somebody is at work (command line)."""

    title = "Place of the backup or restore cannot be used"


class StartupFailed(UltragrayError):
    """The service cannot start, such as on a port in use (command line)."""

    title = "Service cannot start"


def job_not_found(job_id: str) -> JobNotFound:
    """The error at a job that is not there, or that the caller may not see."""
    return JobNotFound(f"there is no job {job_id[:64]!r}", field="job")


def known_names(kind: str, names: Sequence[str]) -> str:
    """The scenes or datasets that there are, the first few by name, for the message that another is not there."""
    shown = ", ".join(names[:_NAMES_IN_MESSAGE]) + (", …" if len(names) > _NAMES_IN_MESSAGE else "")
    return f"known {kind}s: {shown}" if names else f"there are no {kind}s yet"

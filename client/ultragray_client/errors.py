# Generated from the errors of the service by client/generate.py; change those.
"""Every error of the client, in one tree. Programs match the class, or `reason`, which never changes.

ClientError
├── InvalidArgument
│   ├── InvalidPose
│   ├── InvalidProbe
│   ├── InvalidImageSize
│   ├── UnknownOutput
│   ├── LowConfidence
│   ├── TooManyPoses
│   ├── DatasetInvalid
│   └── UploadTooLarge
├── Unauthenticated
├── NotFound
│   ├── SceneNotFound
│   ├── DatasetNotFound
│   ├── JobNotFound
│   └── ArtifactNotFound
├── FailedPrecondition
│   ├── SceneFileInvalid
│   ├── DatasetInUse
│   ├── JobFinished
│   ├── JobNotFinished
│   └── JobInUse
├── AlreadyExists
│   ├── DatasetExists
│   ├── SceneExists
│   └── RequestIdConflict
├── ResourceExhausted
│   ├── StorageFull
│   ├── MemoryExceeded
│   ├── JobQueueFull
│   ├── SceneTooLarge
│   └── QueueFull
├── Unavailable
│   ├── DatabaseUnavailable
│   ├── NotReady
│   ├── Draining
│   └── Unreachable
├── Unimplemented
│   ├── BackendUnavailable
│   └── ExtraMissing
├── DeadlineExceeded
├── RenderFailed
└── StreamEnded

A reason that this client does not know is told with the class of its gRPC status, or ClientError.
"""

from __future__ import annotations

from .client_error import ClientError as ClientError


class InvalidArgument(ClientError, ValueError):
    """A value that cannot be used; `field` names it as the caller wrote it."""

    reason = "INVALID_ARGUMENT"
    grpc_status = "INVALID_ARGUMENT"


class InvalidPose(InvalidArgument):
    """Not a rigid probe→scene transform."""

    reason = "INVALID_POSE"


class InvalidProbe(InvalidArgument):
    """A probe that no transducer could have, such as far ≤ near."""

    reason = "INVALID_PROBE"


class InvalidImageSize(InvalidArgument):
    """Height or width outside the limits."""

    reason = "INVALID_IMAGE_SIZE"


class UnknownOutput(InvalidArgument):
    """An output that does not exist, none at all, or one that the scene does not have."""

    reason = "UNKNOWN_OUTPUT"


class LowConfidence(InvalidArgument):
    """A pose below the `min_confidence` that was asked for."""

    reason = "LOW_CONFIDENCE"


class TooManyPoses(InvalidArgument):
    """More poses, or pixels, than one request may have; send several."""

    reason = "TOO_MANY_POSES"


class DatasetInvalid(InvalidArgument):
    """A tracked sweep that cannot be used; names the file, the frame and the reason."""

    reason = "DATASET_INVALID"


class UploadTooLarge(InvalidArgument):
    """An upload over `ULTRAGRAY_MAX_DATASET_BYTES`, packed or unpacked, or of too many files."""

    reason = "UPLOAD_TOO_LARGE"


class Unauthenticated(ClientError):
    """No API key, or an unknown one."""

    reason = "UNAUTHENTICATED"
    grpc_status = "UNAUTHENTICATED"


class NotFound(ClientError):
    """Base of the errors whose gRPC status is NOT_FOUND."""

    reason = "NOT_FOUND"
    grpc_status = "NOT_FOUND"


class SceneNotFound(NotFound):
    """No scene of that name."""

    reason = "SCENE_NOT_FOUND"


class DatasetNotFound(NotFound):
    """No dataset of that name."""

    reason = "DATASET_NOT_FOUND"


class JobNotFound(NotFound):
    """No job of that id."""

    reason = "JOB_NOT_FOUND"


class ArtifactNotFound(NotFound):
    """The job has no file of that name."""

    reason = "ARTIFACT_NOT_FOUND"


class FailedPrecondition(ClientError):
    """Base of the errors whose gRPC status is FAILED_PRECONDITION."""

    reason = "FAILED_PRECONDITION"
    grpc_status = "FAILED_PRECONDITION"


class SceneFileInvalid(FailedPrecondition):
    """A scene file that is truncated, foreign or inconsistent."""

    reason = "SCENE_FILE_INVALID"


class DatasetInUse(FailedPrecondition):
    """A job needs the dataset."""

    reason = "DATASET_IN_USE"


class JobFinished(FailedPrecondition):
    """A job that succeeded or failed cannot be cancelled."""

    reason = "JOB_FINISHED"


class JobNotFinished(FailedPrecondition):
    """Only a failed or cancelled job can be retried."""

    reason = "JOB_NOT_FINISHED"


class JobInUse(FailedPrecondition):
    """A job that waits or runs, or that another of those goes on from, cannot be deleted."""

    reason = "JOB_IN_USE"


class AlreadyExists(ClientError):
    """Base of the errors whose gRPC status is ALREADY_EXISTS."""

    reason = "ALREADY_EXISTS"
    grpc_status = "ALREADY_EXISTS"


class DatasetExists(AlreadyExists):
    """A dataset of that name has another content or other options; delete it first."""

    reason = "DATASET_EXISTS"


class SceneExists(AlreadyExists):
    """A scene of that name is there, or a job is making it."""

    reason = "SCENE_EXISTS"


class RequestIdConflict(AlreadyExists):
    """The `request_id` was used for something else."""

    reason = "REQUEST_ID_CONFLICT"


class ResourceExhausted(ClientError):
    """Base of the errors whose gRPC status is RESOURCE_EXHAUSTED."""

    reason = "RESOURCE_EXHAUSTED"
    grpc_status = "RESOURCE_EXHAUSTED"


class StorageFull(ResourceExhausted):
    """The artifact folder has no room, or a render job would write more than it has room for."""

    reason = "STORAGE_FULL"


class MemoryExceeded(ResourceExhausted):
    """The check of a dataset or scene file, a comparison, a training, or a frame or scene on a GPU, that does not
    fit into memory; also where the machine has none left.
    """

    reason = "MEMORY_EXCEEDED"


class JobQueueFull(ResourceExhausted):
    """Too many jobs wait; retry."""

    reason = "JOB_QUEUE_FULL"


class SceneTooLarge(ResourceExhausted):
    """A scene that does not fit `ULTRAGRAY_MEMORY_BUDGET_MB` at all."""

    reason = "SCENE_TOO_LARGE"


class QueueFull(ResourceExhausted):
    """Too many frames wait, or too many uploads are under way; retry."""

    reason = "QUEUE_FULL"


class Unavailable(ClientError):
    """Base of the errors whose gRPC status is UNAVAILABLE."""

    reason = "UNAVAILABLE"
    grpc_status = "UNAVAILABLE"


class DatabaseUnavailable(Unavailable):
    """The database of the jobs does not answer; scenes are rendered all the same; retry."""

    reason = "DATABASE_UNAVAILABLE"


class NotReady(Unavailable):
    """The service is starting; retry."""

    reason = "NOT_READY"


class Draining(Unavailable):
    """The service is stopping; retry elsewhere."""

    reason = "DRAINING"


class Unreachable(Unavailable):
    """Nobody answers at the address, or the connection broke."""

    reason = "UNREACHABLE"


class Unimplemented(ClientError):
    """Base of the errors whose gRPC status is UNIMPLEMENTED."""

    reason = "UNIMPLEMENTED"
    grpc_status = "UNIMPLEMENTED"


class BackendUnavailable(Unimplemented):
    """A backend that cannot run here."""

    reason = "BACKEND_UNAVAILABLE"


class ExtraMissing(Unimplemented):
    """A format whose package is not installed: `pip install 'ultragray[dicom]'` and the like (uploads, jobs, command
    line, library).
    """

    reason = "EXTRA_MISSING"


class DeadlineExceeded(ClientError, TimeoutError):
    """The deadline passed first."""

    reason = "DEADLINE_EXCEEDED"
    grpc_status = "DEADLINE_EXCEEDED"


class RenderFailed(ClientError):
    """A worker could not render the frame."""

    reason = "RENDER_FAILED"


class StreamEnded(ClientError):
    """A stream of poses that is over was asked to go on."""

    reason = "STREAM_ENDED"


ERRORS = (
    ClientError,
    InvalidArgument,
    InvalidPose,
    InvalidProbe,
    InvalidImageSize,
    UnknownOutput,
    LowConfidence,
    TooManyPoses,
    DatasetInvalid,
    UploadTooLarge,
    Unauthenticated,
    NotFound,
    SceneNotFound,
    DatasetNotFound,
    JobNotFound,
    ArtifactNotFound,
    FailedPrecondition,
    SceneFileInvalid,
    DatasetInUse,
    JobFinished,
    JobNotFinished,
    JobInUse,
    AlreadyExists,
    DatasetExists,
    SceneExists,
    RequestIdConflict,
    ResourceExhausted,
    StorageFull,
    MemoryExceeded,
    JobQueueFull,
    SceneTooLarge,
    QueueFull,
    Unavailable,
    DatabaseUnavailable,
    NotReady,
    Draining,
    Unreachable,
    Unimplemented,
    BackendUnavailable,
    ExtraMissing,
    DeadlineExceeded,
    RenderFailed,
    StreamEnded,
)

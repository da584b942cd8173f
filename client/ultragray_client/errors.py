# Generated from the errors of the service by client/generate.py; change those.
"""Every error of the client, in one tree. Programs match the class, or `reason`, which never changes.

ClientError
├── InvalidArgument
│   ├── RequestMalformed
│   ├── UploadTooLarge
│   ├── TargetTooLong
│   ├── InvalidPose
│   ├── InvalidProbe
│   ├── InvalidImageSize
│   ├── UnknownOutput
│   ├── LowConfidence
│   ├── FrameTooCostly
│   ├── TooManyPoses
│   ├── DatasetInvalid
│   └── HeadersTooLarge
├── Unauthenticated
├── PermissionDenied
│   └── HostRefused
├── NotFound
│   ├── SceneNotFound
│   ├── RegistrationNotFound
│   ├── DatasetNotFound
│   ├── JobNotFound
│   ├── WorkerNotFound
│   └── ArtifactNotFound
├── DeadlineExceeded
│   ├── RequestTooSlow
│   └── JobTimeExceeded
├── Aborted
│   └── RecordingTaken
├── AlreadyExists
│   ├── DatasetExists
│   ├── SceneExists
│   └── RequestIdConflict
├── FailedPrecondition
│   ├── DatasetInUse
│   ├── JobFinished
│   ├── JobNotFinished
│   ├── JobInUse
│   └── SceneFileInvalid
├── ResourceExhausted
│   ├── LimitReached
│   ├── QueueFull
│   ├── RateLimited
│   ├── JobQueueFull
│   ├── StorageFull
│   ├── MemoryExceeded
│   └── SceneTooLarge
├── JobStalled
├── BackupInvalid
├── RestoreRefused
├── RenderFailed
├── Unimplemented
│   ├── BackendUnavailable
│   └── ExtraMissing
├── Unavailable
│   ├── TooManyConnections
│   ├── NotReady
│   ├── Draining
│   ├── IssuerUnavailable
│   ├── StorageUnavailable
│   ├── DatabaseUnavailable
│   ├── ArtifactFolderUnavailable
│   └── Unreachable
├── TlsFailed
└── StreamEnded

A reason that this client does not know is told with the class of its gRPC status, or ClientError.
"""

from __future__ import annotations

from .client_error import ClientError as ClientError


class InvalidArgument(ClientError, ValueError):
    """A value that cannot be used; `field` names it as the caller wrote it."""


class RequestMalformed(InvalidArgument):
    """Bytes that are no HTTP request, or too many requests at once on one connection."""


class UploadTooLarge(InvalidArgument):
    """An upload over `ULTRAGRAY_MAX_DATASET_BYTES`, packed or unpacked, or of too many files."""


class TargetTooLong(InvalidArgument):
    """Path and query of a request over 16 KiB."""


class InvalidPose(InvalidArgument):
    """Not a rigid probe→scene transform."""


class InvalidProbe(InvalidArgument):
    """A probe that no transducer could have, such as far ≤ near."""


class InvalidImageSize(InvalidArgument):
    """Height or width outside the limits."""


class UnknownOutput(InvalidArgument):
    """An output that does not exist, none at all, or one that the scene does not have."""


class LowConfidence(InvalidArgument):
    """A pose below the `min_confidence` that was asked for."""


class FrameTooCostly(InvalidArgument):
    """A frame whose Gaussians cover more pixels than `ULTRAGRAY_MAX_FOOTPRINT_PIXELS` allows; ask for a smaller one."""


class TooManyPoses(InvalidArgument):
    """More poses, or pixels, than one request may have; send several."""


class DatasetInvalid(InvalidArgument):
    """A tracked sweep that cannot be used; names the file, the frame and the reason."""


class HeadersTooLarge(InvalidArgument):
    """The head of a request over `ULTRAGRAY_MAX_HEADER_BYTES`, or more headers than `ULTRAGRAY_MAX_HEADERS`."""


class Unauthenticated(ClientError):
    """No API key, or an unknown one."""


class PermissionDenied(ClientError):
    """A role that may not do what was asked, or something that belongs to somebody else."""


class HostRefused(PermissionDenied):
    """A `Host` that the service is not known as, where it asks for no key."""


class NotFound(ClientError):
    """Base of the errors whose gRPC status is NOT_FOUND."""


class SceneNotFound(NotFound):
    """No scene of that name."""


class RegistrationNotFound(NotFound):
    """No registration of that name."""


class DatasetNotFound(NotFound):
    """No dataset of that name."""


class JobNotFound(NotFound):
    """No job of that id."""


class WorkerNotFound(NotFound):
    """No worker of that name."""


class ArtifactNotFound(NotFound):
    """The job has no file of that name."""


class DeadlineExceeded(ClientError, TimeoutError):
    """The deadline passed first."""


class RequestTooSlow(DeadlineExceeded):
    """A head that took longer than `ULTRAGRAY_HEADER_TIMEOUT_S`, or a body below `ULTRAGRAY_MIN_BYTES_PER_S`."""


class JobTimeExceeded(DeadlineExceeded):
    """A job ran longer than its `max_run_s`, or `ULTRAGRAY_JOB_MAX_RUN_S`, and was ended."""


class Aborted(ClientError):
    """Base of the errors whose gRPC status is ABORTED."""


class RecordingTaken(Aborted):
    """Two record into one recording at a time; one may."""


class AlreadyExists(ClientError):
    """Base of the errors whose gRPC status is ALREADY_EXISTS."""


class DatasetExists(AlreadyExists):
    """A dataset of that name has another content or other options; delete it first."""


class SceneExists(AlreadyExists):
    """A scene of that name is there, or a job is making it."""


class RequestIdConflict(AlreadyExists):
    """The `request_id` was used for something else."""


class FailedPrecondition(ClientError):
    """Base of the errors whose gRPC status is FAILED_PRECONDITION."""


class DatasetInUse(FailedPrecondition):
    """A job needs the dataset."""


class JobFinished(FailedPrecondition):
    """A job that succeeded or failed cannot be cancelled."""


class JobNotFinished(FailedPrecondition):
    """Only a failed or cancelled job can be retried."""


class JobInUse(FailedPrecondition):
    """A job that waits or runs, or that another of those goes on from, cannot be deleted."""


class SceneFileInvalid(FailedPrecondition):
    """A scene file that is truncated, foreign or inconsistent."""


class ResourceExhausted(ClientError):
    """Base of the errors whose gRPC status is RESOURCE_EXHAUSTED."""


class LimitReached(ResourceExhausted):
    """As many streams, jobs, minutes of compute or bytes as the key may have; end or delete some, or wait."""


class QueueFull(ResourceExhausted):
    """Too many frames wait, or too many uploads are under way; retry."""


class RateLimited(ResourceExhausted):
    """More requests or frames in a second than the key may have; retry."""


class JobQueueFull(ResourceExhausted):
    """Too many jobs wait; retry."""


class StorageFull(ResourceExhausted):
    """The artifact folder has no room, or a render job would write more than it has room for."""


class MemoryExceeded(ResourceExhausted):
    """The check of a dataset or scene file, a comparison, a training, or a frame or scene on a GPU, that does not
    fit into memory; also where the machine has none left.
    """


class SceneTooLarge(ResourceExhausted):
    """A scene that does not fit `ULTRAGRAY_MEMORY_BUDGET_MB` at all."""


class JobStalled(ClientError):
    """The process of a job neither computed nor read nor wrote for `ULTRAGRAY_JOB_STALL_TIMEOUT_S`, and was ended."""


class BackupInvalid(ClientError):
    """A backup that is not there, damaged, or made by a newer release (command line)."""


class RestoreRefused(ClientError):
    """A backup or restore into a place that holds something else, or where somebody is at work (command line)."""


class RenderFailed(ClientError):
    """A worker could not render the frame."""


class Unimplemented(ClientError):
    """Base of the errors whose gRPC status is UNIMPLEMENTED."""


class BackendUnavailable(Unimplemented):
    """A backend that cannot run here."""


class ExtraMissing(Unimplemented):
    """A format, a command or traces whose package is not installed; the sentence says how to install it (uploads,
    jobs, command line, library).
    """


class Unavailable(ClientError):
    """Base of the errors whose gRPC status is UNAVAILABLE."""


class TooManyConnections(Unavailable):
    """Connections over `ULTRAGRAY_MAX_CONNECTIONS`, or of one address over the limit of those; retry."""


class NotReady(Unavailable):
    """The service is starting, or cannot render at the moment; retry."""


class Draining(Unavailable):
    """The service is stopping; retry elsewhere."""


class IssuerUnavailable(Unavailable):
    """The issuer of a token does not answer, so that the token cannot be checked; API keys work all the same; retry."""


class StorageUnavailable(Unavailable):
    """The object storage does not answer, or refuses its credentials; what is cached is served all the same; retry."""


class DatabaseUnavailable(Unavailable):
    """The database of the jobs is away or takes no changes; scenes are rendered all the same; retry."""


class ArtifactFolderUnavailable(Unavailable):
    """The artifact folder is gone, or not the one that the jobs belong to: its share is not mounted; retry."""


class Unreachable(Unavailable):
    """Nobody answers at the address, or the connection broke."""


class TlsFailed(ClientError):
    """The service shows no certificate to trust, or does not speak TLS."""


class StreamEnded(ClientError):
    """A stream of poses that is over was asked to go on."""


ERRORS = ClientError.branch()

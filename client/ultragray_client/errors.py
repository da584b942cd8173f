"""Every error of the client, in one tree. Programs match the class, or `reason`, which never changes.

ClientError                         what the service refused or could not do, or did not answer
├── InvalidArgument                 a value that cannot be used; names the field (also a ValueError)
│   ├── InvalidPose                 INVALID_POSE
│   ├── InvalidProbe                INVALID_PROBE
│   ├── InvalidImageSize            INVALID_IMAGE_SIZE
│   ├── UnknownOutput               UNKNOWN_OUTPUT
│   ├── LowConfidence               LOW_CONFIDENCE: a pose too far from the training views
│   ├── TooManyPoses                TOO_MANY_POSES
│   ├── DatasetInvalid              DATASET_INVALID
│   └── UploadTooLarge              UPLOAD_TOO_LARGE
├── Unauthenticated                 no API key, or an unknown one
├── NotFound
│   ├── SceneNotFound               SCENE_NOT_FOUND
│   ├── DatasetNotFound             DATASET_NOT_FOUND
│   ├── JobNotFound                 JOB_NOT_FOUND
│   └── ArtifactNotFound            ARTIFACT_NOT_FOUND
├── AlreadyExists
│   ├── SceneExists                 SCENE_EXISTS
│   ├── DatasetExists               DATASET_EXISTS
│   └── RequestIdConflict           REQUEST_ID_CONFLICT
├── FailedPrecondition              not in the state that things are in
│   ├── SceneFileInvalid            SCENE_FILE_INVALID
│   ├── DatasetInUse                DATASET_IN_USE
│   ├── JobFinished                 JOB_FINISHED
│   ├── JobNotFinished              JOB_NOT_FINISHED
│   └── JobInUse                    JOB_IN_USE
├── ResourceExhausted
│   ├── QueueFull                   QUEUE_FULL; asked again
│   ├── JobQueueFull                JOB_QUEUE_FULL; asked again
│   ├── StorageFull                 STORAGE_FULL
│   ├── MemoryExceeded              MEMORY_EXCEEDED
│   └── SceneTooLarge               SCENE_TOO_LARGE
├── Unavailable                     asked again, until the time is over
│   ├── NotReady                    NOT_READY
│   ├── Draining                    DRAINING
│   ├── DatabaseUnavailable         DATABASE_UNAVAILABLE
│   └── Unreachable                 UNREACHABLE: nobody answers at the address, or the connection broke
├── Unimplemented                   what this service cannot do
│   ├── BackendUnavailable          BACKEND_UNAVAILABLE
│   └── ExtraMissing                EXTRA_MISSING: a format whose package is not installed there
├── DeadlineExceeded                DEADLINE_EXCEEDED (also a TimeoutError)
├── RenderFailed                    RENDER_FAILED
└── StreamEnded                     STREAM_ENDED: a stream of poses that is over was asked for another frame

A reason that this client does not know is told with the class of its gRPC status, or ClientError.
"""

from __future__ import annotations


class ClientError(Exception):
    """A call that failed: the stable `reason`, and `detail`, one sentence for people.

    None where there is none: `field` (the path of what is to blame), `retry_after_s` (seconds after which it may
    succeed), and in a stream `sequence` (of the pose that gets no frame).
    """

    reason = "INTERNAL"
    grpc_status = "INTERNAL"

    def __init__(
        self,
        detail: str,
        *,
        reason: str | None = None,
        field: str | None = None,
        retry_after_s: float | None = None,
        sequence: int | None = None,
    ) -> None:
        super().__init__(detail)
        self.detail = detail
        self.reason = reason or self.reason
        self.field = field
        self.retry_after_s = retry_after_s
        self.sequence = sequence

    def __str__(self) -> str:
        return f"{self.reason}: {self.detail}"


class InvalidArgument(ClientError, ValueError):
    reason = grpc_status = "INVALID_ARGUMENT"


class InvalidPose(InvalidArgument):
    reason = "INVALID_POSE"


class InvalidProbe(InvalidArgument):
    reason = "INVALID_PROBE"


class InvalidImageSize(InvalidArgument):
    reason = "INVALID_IMAGE_SIZE"


class UnknownOutput(InvalidArgument):
    reason = "UNKNOWN_OUTPUT"


class LowConfidence(InvalidArgument):
    reason = "LOW_CONFIDENCE"


class TooManyPoses(InvalidArgument):
    reason = "TOO_MANY_POSES"


class DatasetInvalid(InvalidArgument):
    reason = "DATASET_INVALID"


class UploadTooLarge(InvalidArgument):
    reason = "UPLOAD_TOO_LARGE"


class Unauthenticated(ClientError):
    reason = grpc_status = "UNAUTHENTICATED"


class NotFound(ClientError):
    reason = grpc_status = "NOT_FOUND"


class SceneNotFound(NotFound):
    reason = "SCENE_NOT_FOUND"


class DatasetNotFound(NotFound):
    reason = "DATASET_NOT_FOUND"


class JobNotFound(NotFound):
    reason = "JOB_NOT_FOUND"


class ArtifactNotFound(NotFound):
    reason = "ARTIFACT_NOT_FOUND"


class AlreadyExists(ClientError):
    reason = grpc_status = "ALREADY_EXISTS"


class SceneExists(AlreadyExists):
    reason = "SCENE_EXISTS"


class DatasetExists(AlreadyExists):
    reason = "DATASET_EXISTS"


class RequestIdConflict(AlreadyExists):
    reason = "REQUEST_ID_CONFLICT"


class FailedPrecondition(ClientError):
    reason = grpc_status = "FAILED_PRECONDITION"


class SceneFileInvalid(FailedPrecondition):
    reason = "SCENE_FILE_INVALID"


class DatasetInUse(FailedPrecondition):
    reason = "DATASET_IN_USE"


class JobFinished(FailedPrecondition):
    reason = "JOB_FINISHED"


class JobNotFinished(FailedPrecondition):
    reason = "JOB_NOT_FINISHED"


class JobInUse(FailedPrecondition):
    reason = "JOB_IN_USE"


class ResourceExhausted(ClientError):
    reason = grpc_status = "RESOURCE_EXHAUSTED"


class QueueFull(ResourceExhausted):
    reason = "QUEUE_FULL"


class JobQueueFull(ResourceExhausted):
    reason = "JOB_QUEUE_FULL"


class StorageFull(ResourceExhausted):
    reason = "STORAGE_FULL"


class MemoryExceeded(ResourceExhausted):
    reason = "MEMORY_EXCEEDED"


class SceneTooLarge(ResourceExhausted):
    reason = "SCENE_TOO_LARGE"


class Unavailable(ClientError):
    reason = grpc_status = "UNAVAILABLE"


class NotReady(Unavailable):
    reason = "NOT_READY"


class Draining(Unavailable):
    reason = "DRAINING"


class DatabaseUnavailable(Unavailable):
    reason = "DATABASE_UNAVAILABLE"


class Unreachable(Unavailable):
    reason = "UNREACHABLE"


class Unimplemented(ClientError):
    reason = grpc_status = "UNIMPLEMENTED"


class BackendUnavailable(Unimplemented):
    reason = "BACKEND_UNAVAILABLE"


class ExtraMissing(Unimplemented):
    reason = "EXTRA_MISSING"


class DeadlineExceeded(ClientError, TimeoutError):
    reason = grpc_status = "DEADLINE_EXCEEDED"


class RenderFailed(ClientError):
    reason = "RENDER_FAILED"


class StreamEnded(ClientError):
    reason = "STREAM_ENDED"

    @classmethod
    def for_sending(cls) -> StreamEnded:
        """The error of a pose that comes too late."""
        return cls("the stream takes no more poses: done_sending was called, or it is over")


ERRORS = tuple(value for value in vars().values() if isinstance(value, type) and issubclass(value, ClientError))

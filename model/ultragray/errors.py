"""Every error of the project, in one tree.

UltragrayError
├── InvalidArgument                 the caller gave something that cannot be used; names the field
│   ├── InvalidPose                 not a rigid probe→scene transform
│   ├── InvalidProbe                a probe that no transducer could have
│   ├── InvalidImageSize            height or width outside the limits
│   ├── UnknownOutput               an output that is none, or that a scene has not
│   ├── LowConfidence               a pose too far from the training views, where a confidence is asked for
│   └── TooManyPoses                more poses in one request than the limit
├── Unauthenticated                 no API key, or an unknown one, where the service asks for one
├── OriginRefused                   a web page of another site opens a stream
├── BodyTooLarge                    a request body over the limit
├── NotAcceptable                   the Accept header cannot hold what was asked for
├── UnsupportedMediaType            a request body that is not JSON
├── IgtlMessageInvalid              an OpenIGTLink message whose header, checksum or body cannot be used
├── RouteNotFound                   no such path
├── MethodNotAllowed                the path exists, the method does not
├── SceneNotFound                   no scene of that name
├── SceneFileInvalid                a scene file that is truncated, foreign or inconsistent
├── CheckpointInvalid               a released checkpoint, or its conf.json or poses, that cannot be imported
├── DatasetInvalid                  a tracked sweep that cannot be used; names the file, the frame and the reason
├── DatasetNotFound                 no dataset of that name
├── DatasetExists                   a dataset of that name holds something else
├── DatasetInUse                    a job needs the dataset
├── UploadTooLarge                  an upload over the limit, packed or unpacked
├── StorageFull                     a disk that has no room for what was sent
├── TrainingDiverged                a training whose loss or parameters are no longer finite
├── TrainingStateInvalid            a training folder that cannot be resumed from
├── MemoryExceeded                  a training, a check, a comparison, or a frame on a GPU, that does not fit in memory
├── SceneExists                     a scene of that name is there, or a job is making it
├── SceneReadOnly                   a scene of the data folder cannot be deleted
├── DatabaseUnavailable             the database of the jobs does not answer; nothing else is affected
├── JobNotFound                     no job of that id
├── JobConflict                     the request_id was used for something else
├── JobFinished                     a job that succeeded or failed cannot be cancelled
├── JobNotFinished                  only a failed or cancelled job can be retried
├── JobInUse                        a job that waits or runs, or that another goes on from, cannot be deleted
├── JobQueueFull                    too many jobs wait already
├── ArtifactNotFound                the job has no file of that name
├── SceneTooLarge                   a scene that does not fit the memory budget at all
├── BackendUnavailable              a render backend that cannot run here
├── ExtraMissing                    a format whose package is not installed here
├── QueueFull                       too many frames wait already
├── DeadlineExceeded                the deadline passed before the frame was rendered
├── NotReady                        the service is starting
├── Draining                        the service is stopping
├── StartupFailed                   the service cannot start, such as on a port in use
└── RenderFailed                    a worker could not render the frame

Each class carries a `reason` that never changes (clients match on it), the HTTP status and the gRPC status that the
front doors answer with: this module is the one table that maps both.
"""

from __future__ import annotations

from typing import ClassVar


class UltragrayError(Exception):
    """Base of all errors; `str(error)` is one sentence for a person."""

    reason: ClassVar[str] = "INTERNAL"
    http_status: ClassVar[int] = 500
    grpc_status: ClassVar[str] = "INTERNAL"
    title: ClassVar[str] = "Internal error"
    retry_after_s: ClassVar[int | None] = None  # when the same request may succeed; None: not by waiting

    def __init__(self, detail: str, *, field: str | None = None) -> None:
        super().__init__(detail)
        self.detail = detail
        self.field = field

    def __reduce__(self) -> tuple[object, ...]:  # crosses the pipe from a worker unchanged
        return _rebuild, (type(self), self.detail, self.field)


def _rebuild(cls: type[UltragrayError], detail: str, field: str | None) -> UltragrayError:
    return cls(detail, field=field)


class InvalidArgument(UltragrayError, ValueError):
    """A value that cannot be used. `field` is the path of the value as the caller wrote it."""

    reason = "INVALID_ARGUMENT"
    http_status = 422
    grpc_status = "INVALID_ARGUMENT"
    title = "Invalid argument"


class InvalidPose(InvalidArgument):
    reason = "INVALID_POSE"
    title = "Not a rigid probe-to-scene transform"


class InvalidProbe(InvalidArgument):
    reason = "INVALID_PROBE"
    title = "Invalid probe"


class InvalidImageSize(InvalidArgument):
    reason = "INVALID_IMAGE_SIZE"
    title = "Invalid image size"


class UnknownOutput(InvalidArgument):
    reason = "UNKNOWN_OUTPUT"
    title = "Unknown output"


class LowConfidence(InvalidArgument):
    reason = "LOW_CONFIDENCE"
    title = "The confidence is too low"


class TooManyPoses(InvalidArgument):
    reason = "TOO_MANY_POSES"
    title = "Too many poses"


class Unauthenticated(UltragrayError):
    reason = "UNAUTHENTICATED"
    http_status = 401
    grpc_status = "UNAUTHENTICATED"
    title = "Authentication required"


class OriginRefused(UltragrayError):
    reason = "ORIGIN_REFUSED"
    http_status = 403
    grpc_status = "PERMISSION_DENIED"
    title = "Pages of this origin are not allowed"


class BodyTooLarge(UltragrayError):
    reason = "BODY_TOO_LARGE"
    http_status = 413
    grpc_status = "INVALID_ARGUMENT"
    title = "Request body too large"


class NotAcceptable(UltragrayError):
    reason = "NOT_ACCEPTABLE"
    http_status = 406
    grpc_status = "INVALID_ARGUMENT"
    title = "Accept header cannot be satisfied"


class UnsupportedMediaType(UltragrayError):
    reason = "UNSUPPORTED_MEDIA_TYPE"
    http_status = 415
    grpc_status = "INVALID_ARGUMENT"
    title = "Unsupported media type"


class IgtlMessageInvalid(UltragrayError):
    reason = "IGTL_MESSAGE_INVALID"
    http_status = 400
    grpc_status = "INVALID_ARGUMENT"
    title = "Invalid OpenIGTLink message"


class RouteNotFound(UltragrayError):
    reason = "ROUTE_NOT_FOUND"
    http_status = 404
    grpc_status = "UNIMPLEMENTED"
    title = "No such route"


class MethodNotAllowed(UltragrayError):
    reason = "METHOD_NOT_ALLOWED"
    http_status = 405
    grpc_status = "UNIMPLEMENTED"
    title = "Method not allowed"


class SceneNotFound(UltragrayError):
    reason = "SCENE_NOT_FOUND"
    http_status = 404
    grpc_status = "NOT_FOUND"
    title = "No such scene"


class SceneFileInvalid(UltragrayError):
    reason = "SCENE_FILE_INVALID"
    http_status = 422
    grpc_status = "FAILED_PRECONDITION"
    title = "Invalid scene file"


class CheckpointInvalid(UltragrayError):
    reason = "CHECKPOINT_INVALID"
    http_status = 422
    grpc_status = "INVALID_ARGUMENT"
    title = "Invalid checkpoint"


class DatasetInvalid(UltragrayError):
    reason = "DATASET_INVALID"
    http_status = 422
    grpc_status = "INVALID_ARGUMENT"
    title = "Invalid dataset"


class DatasetNotFound(UltragrayError):
    reason = "DATASET_NOT_FOUND"
    http_status = 404
    grpc_status = "NOT_FOUND"
    title = "No such dataset"


class DatasetExists(UltragrayError):
    reason = "DATASET_EXISTS"
    http_status = 409
    grpc_status = "ALREADY_EXISTS"
    title = "Another dataset has that name"


class DatasetInUse(UltragrayError):
    reason = "DATASET_IN_USE"
    http_status = 409
    grpc_status = "FAILED_PRECONDITION"
    title = "Dataset in use"


class UploadTooLarge(UltragrayError):
    reason = "UPLOAD_TOO_LARGE"
    http_status = 413
    grpc_status = "INVALID_ARGUMENT"
    title = "Upload too large"


class StorageFull(UltragrayError):
    reason = "STORAGE_FULL"
    http_status = 507
    grpc_status = "RESOURCE_EXHAUSTED"
    title = "No room on the disk"


class TrainingDiverged(UltragrayError):
    reason = "TRAINING_DIVERGED"
    http_status = 422
    grpc_status = "FAILED_PRECONDITION"
    title = "Training diverged"


class TrainingStateInvalid(UltragrayError):
    reason = "TRAINING_STATE_INVALID"
    http_status = 422
    grpc_status = "FAILED_PRECONDITION"
    title = "Training cannot be resumed"


class MemoryExceeded(UltragrayError):
    reason = "MEMORY_EXCEEDED"
    http_status = 507
    grpc_status = "RESOURCE_EXHAUSTED"
    title = "Memory exceeded"


class SceneExists(UltragrayError):
    reason = "SCENE_EXISTS"
    http_status = 409
    grpc_status = "ALREADY_EXISTS"
    title = "Scene already exists"


class SceneReadOnly(UltragrayError):
    reason = "SCENE_READ_ONLY"
    http_status = 403
    grpc_status = "PERMISSION_DENIED"
    title = "Scene cannot be deleted"


class DatabaseUnavailable(UltragrayError):
    reason = "DATABASE_UNAVAILABLE"
    http_status = 503
    grpc_status = "UNAVAILABLE"
    title = "The database of the jobs does not answer"
    retry_after_s = 5


class JobNotFound(UltragrayError):
    reason = "JOB_NOT_FOUND"
    http_status = 404
    grpc_status = "NOT_FOUND"
    title = "No such job"


class JobConflict(UltragrayError):
    reason = "REQUEST_ID_CONFLICT"
    http_status = 409
    grpc_status = "ALREADY_EXISTS"
    title = "Request id used for another job"


class JobFinished(UltragrayError):
    reason = "JOB_FINISHED"
    http_status = 409
    grpc_status = "FAILED_PRECONDITION"
    title = "Job is finished"


class JobNotFinished(UltragrayError):
    reason = "JOB_NOT_FINISHED"
    http_status = 409
    grpc_status = "FAILED_PRECONDITION"
    title = "Job cannot be retried"


class JobInUse(UltragrayError):
    reason = "JOB_IN_USE"
    http_status = 409
    grpc_status = "FAILED_PRECONDITION"
    title = "Job in use"


class JobQueueFull(UltragrayError):
    reason = "JOB_QUEUE_FULL"
    http_status = 429
    grpc_status = "RESOURCE_EXHAUSTED"
    title = "Too many jobs are waiting"
    retry_after_s = 10


class ArtifactNotFound(UltragrayError):
    reason = "ARTIFACT_NOT_FOUND"
    http_status = 404
    grpc_status = "NOT_FOUND"
    title = "No such artifact"


class SceneTooLarge(UltragrayError):
    reason = "SCENE_TOO_LARGE"
    http_status = 507
    grpc_status = "RESOURCE_EXHAUSTED"
    title = "Scene exceeds the memory budget"


class BackendUnavailable(UltragrayError):
    reason = "BACKEND_UNAVAILABLE"
    http_status = 501
    grpc_status = "UNIMPLEMENTED"
    title = "Render backend unavailable"


class ExtraMissing(UltragrayError):
    reason = "EXTRA_MISSING"
    http_status = 501
    grpc_status = "UNIMPLEMENTED"
    title = "Optional package not installed"


class QueueFull(UltragrayError):
    reason = "QUEUE_FULL"
    http_status = 429
    grpc_status = "RESOURCE_EXHAUSTED"
    title = "Too much is waiting"
    retry_after_s = 1


class DeadlineExceeded(UltragrayError):
    reason = "DEADLINE_EXCEEDED"
    http_status = 504
    grpc_status = "DEADLINE_EXCEEDED"
    title = "Deadline exceeded"


class NotReady(UltragrayError):
    reason = "NOT_READY"
    http_status = 503
    grpc_status = "UNAVAILABLE"
    title = "Service is starting"
    retry_after_s = 1


class Draining(UltragrayError):
    reason = "DRAINING"
    http_status = 503
    grpc_status = "UNAVAILABLE"
    title = "Service is stopping"
    retry_after_s = 1


class StartupFailed(UltragrayError):
    reason = "STARTUP_FAILED"
    title = "Service cannot start"


class RenderFailed(UltragrayError):
    reason = "RENDER_FAILED"
    title = "Rendering failed"

"""The errors of the front doors, and the one table of the statuses that the doors answer with."""

from __future__ import annotations

from dataclasses import dataclass

from ultragray.contract import described
from ultragray.errors import UltragrayError


class Unauthenticated(UltragrayError, title="Authentication required"):
    """No API key, or an unknown one."""


class IssuerUnavailable(UltragrayError, title="The issuer of the token does not answer"):
    """The issuer of a token does not answer, so that the token cannot be checked; API keys work all the same; retry."""


class PermissionDenied(UltragrayError, title="Not allowed to this key"):
    """A role that may not do what was asked, or something that belongs to somebody else."""


class RateLimited(UltragrayError, title="Too many in a second for this key"):
    """More requests or frames in a second than the key may have; retry."""


class LimitReached(UltragrayError, title="This key has as much as it may"):
    """As many streams, jobs, minutes of compute or bytes as the key may have; end or delete some, or wait."""


class HostRefused(UltragrayError, title="Unknown host name"):
    """A `Host` that the service is not known as, where it asks for no key."""


class OriginRefused(UltragrayError, title="Pages of this origin are not allowed"):
    """A page of another site opens a stream, or asks for anything where no key is asked for."""


class BodyTooLarge(UltragrayError, title="Request body too large"):
    """A body over `ULTRAGRAY_MAX_BODY_BYTES`."""


class NotAcceptable(UltragrayError, title="Accept header cannot be satisfied"):
    """The Accept header allows no type that can hold the request."""


class UnsupportedMediaType(UltragrayError, title="Unsupported media type"):
    """A body that is not JSON (of an upload: no archive and no form), or compressed."""


class HeadersTooLarge(UltragrayError, title="Request headers too large"):
    """The head of a request over `ULTRAGRAY_MAX_HEADER_BYTES`, or more headers than `ULTRAGRAY_MAX_HEADERS`."""


class TargetTooLong(UltragrayError, title="Request target too long"):
    """Path and query of a request over 16 KiB."""


class RequestMalformed(UltragrayError, title="Not an HTTP request"):
    """Bytes that are no HTTP request, or too many requests at once on one connection."""


class RequestTooSlow(UltragrayError, title="The request came too slowly"):
    """A head that took longer than `ULTRAGRAY_HEADER_TIMEOUT_S`, or a body below `ULTRAGRAY_MIN_BYTES_PER_S`."""


class TooManyConnections(UltragrayError, title="Too many connections"):
    """Connections over `ULTRAGRAY_MAX_CONNECTIONS`, or of one address over the limit of those; retry."""


class IgtlMessageInvalid(UltragrayError, title="Invalid OpenIGTLink message"):
    """An OpenIGTLink message whose header, checksum or content cannot be used."""


class RouteNotFound(UltragrayError, title="No such route"):
    """No such path."""


class MethodNotAllowed(UltragrayError, title="Method not allowed"):
    """The path exists, the method does not."""


class StreamNotFound(UltragrayError, title="No such open stream"):
    """No open stream of that id that the key may watch: it has ended, or is at another service of the same address."""


class SceneReadOnly(UltragrayError, title="Scene cannot be changed"):
    """A scene of the data folder can neither be deleted nor get other labels over the service."""


@dataclass(frozen=True)
class Refusal:
    """An error where a call as a whole does not fail."""

    reason: str = described("Stable, for programs.")
    detail: str = described("One sentence for a person.")
    field: str | None = described("Path of the value to blame, null if none is.")

    @classmethod
    def of(cls, error: UltragrayError) -> Refusal:
        """The facts of an error."""
        return cls(error.reason, error.detail, error.field)


@dataclass(frozen=True)
class Statuses:
    """The answer of the doors to an error. `retry_after_s`: when the same request may succeed; None: not by waiting."""

    http: int
    grpc: str
    retry_after_s: int | None = None


STATUSES = {  # by the reason of the error
    reason: statuses
    for statuses, reasons in {
        Statuses(400, "INVALID_ARGUMENT"): "REQUEST_MALFORMED IGTL_MESSAGE_INVALID",
        Statuses(401, "UNAUTHENTICATED"): "UNAUTHENTICATED",
        Statuses(403, "PERMISSION_DENIED"): "PERMISSION_DENIED HOST_REFUSED ORIGIN_REFUSED SCENE_READ_ONLY",
        Statuses(404, "NOT_FOUND"): (
            "SCENE_NOT_FOUND REGISTRATION_NOT_FOUND DATASET_NOT_FOUND JOB_NOT_FOUND WORKER_NOT_FOUND "
            "ARTIFACT_NOT_FOUND STREAM_NOT_FOUND"
        ),
        Statuses(404, "UNIMPLEMENTED"): "ROUTE_NOT_FOUND",
        Statuses(405, "UNIMPLEMENTED"): "METHOD_NOT_ALLOWED",
        Statuses(406, "INVALID_ARGUMENT"): "NOT_ACCEPTABLE",
        Statuses(408, "DEADLINE_EXCEEDED"): "REQUEST_TOO_SLOW",
        Statuses(409, "ABORTED"): "RECORDING_TAKEN",
        Statuses(409, "ALREADY_EXISTS"): "DATASET_EXISTS SCENE_EXISTS REQUEST_ID_CONFLICT",
        Statuses(409, "FAILED_PRECONDITION"): "DATASET_IN_USE JOB_FINISHED JOB_NOT_FINISHED JOB_IN_USE",
        Statuses(413, "INVALID_ARGUMENT"): "BODY_TOO_LARGE UPLOAD_TOO_LARGE",
        Statuses(414, "INVALID_ARGUMENT"): "TARGET_TOO_LONG",
        Statuses(415, "INVALID_ARGUMENT"): "UNSUPPORTED_MEDIA_TYPE",
        Statuses(422, "FAILED_PRECONDITION"): "SCENE_FILE_INVALID TRAINING_DIVERGED TRAINING_STATE_INVALID",
        Statuses(422, "INVALID_ARGUMENT"): (
            "INVALID_ARGUMENT INVALID_POSE INVALID_PROBE INVALID_IMAGE_SIZE UNKNOWN_OUTPUT LOW_CONFIDENCE "
            "FRAME_TOO_COSTLY TOO_MANY_POSES CHECKPOINT_INVALID DATASET_INVALID"
        ),
        Statuses(429, "RESOURCE_EXHAUSTED"): "LIMIT_REACHED",
        Statuses(429, "RESOURCE_EXHAUSTED", retry_after_s=1): "QUEUE_FULL RATE_LIMITED",
        Statuses(429, "RESOURCE_EXHAUSTED", retry_after_s=10): "JOB_QUEUE_FULL",
        Statuses(431, "INVALID_ARGUMENT"): "HEADERS_TOO_LARGE",
        Statuses(500, "INTERNAL"): "INTERNAL JOB_STALLED BACKUP_INVALID RESTORE_REFUSED STARTUP_FAILED RENDER_FAILED",
        Statuses(501, "UNIMPLEMENTED"): "BACKEND_UNAVAILABLE EXTRA_MISSING",
        Statuses(503, "UNAVAILABLE", retry_after_s=1): "TOO_MANY_CONNECTIONS NOT_READY DRAINING",
        Statuses(503, "UNAVAILABLE", retry_after_s=5): (
            "ISSUER_UNAVAILABLE STORAGE_UNAVAILABLE DATABASE_UNAVAILABLE ARTIFACT_FOLDER_UNAVAILABLE"
        ),
        Statuses(504, "DEADLINE_EXCEEDED"): "JOB_TIME_EXCEEDED DEADLINE_EXCEEDED",
        Statuses(507, "RESOURCE_EXHAUSTED"): "STORAGE_FULL MEMORY_EXCEEDED SCENE_TOO_LARGE",
    }.items()
    for reason in reasons.split()
}


def retry_after_s(error: UltragrayError) -> float | None:
    """When the same request may succeed; None: not by waiting."""
    return statuses_of(error).retry_after_s if error.retry_after_s is None else error.retry_after_s


def statuses_of(error: UltragrayError | type[UltragrayError]) -> Statuses:
    """The answer of the doors to an error."""
    return STATUSES[error.reason]

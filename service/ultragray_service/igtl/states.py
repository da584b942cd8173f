"""Errors as OpenIGTLink states: the protocol's own list of codes, and one table from ours to it."""

from __future__ import annotations

from ultragray.errors import BackendUnavailable, InvalidArgument, MemoryExceeded, SceneFileInvalid, UltragrayError
from ultragray_service.errors import (
    IgtlMessageInvalid,
    LimitReached,
    PermissionDenied,
    RateLimited,
    TooManyConnections,
    Unauthenticated,
    statuses_of,
)
from ultragray_service.igtl.contents import Status
from ultragray_workers.errors import (
    DeadlineExceeded,
    Draining,
    NotReady,
    QueueFull,
    RegistrationNotFound,
    SceneNotFound,
    SceneTooLarge,
    StorageUnavailable,
)

OK, UNKNOWN_ERROR, NOT_FOUND, ACCESS_DENIED, BUSY, TIMED_OUT = 1, 2, 4, 5, 6, 7
CHECKSUM_ERROR, CONFIGURATION_ERROR, NO_RESOURCES, UNKNOWN_INSTRUCTION, NOT_READY, SHUTTING_DOWN = 9, 10, 11, 12, 13, 19

_CODES: dict[type[UltragrayError], int] = {
    SceneNotFound: NOT_FOUND,
    RegistrationNotFound: NOT_FOUND,
    PermissionDenied: ACCESS_DENIED,
    Unauthenticated: ACCESS_DENIED,
    QueueFull: BUSY,
    TooManyConnections: BUSY,
    RateLimited: BUSY,
    LimitReached: BUSY,
    DeadlineExceeded: TIMED_OUT,
    InvalidArgument: CONFIGURATION_ERROR,
    SceneFileInvalid: CONFIGURATION_ERROR,
    MemoryExceeded: NO_RESOURCES,
    SceneTooLarge: NO_RESOURCES,
    IgtlMessageInvalid: UNKNOWN_INSTRUCTION,
    BackendUnavailable: UNKNOWN_INSTRUCTION,
    NotReady: NOT_READY,
    StorageUnavailable: NOT_READY,
    Draining: SHUTTING_DOWN,
}


def state_of(error: UltragrayError) -> Status:
    """The state that tells an error: code of the list, HTTP status as sub-code, reason as name, detail as text."""
    if isinstance(error, IgtlMessageInvalid) and error.field == "crc":
        code = CHECKSUM_ERROR
    else:
        code = next((code for kind, code in _CODES.items() if isinstance(error, kind)), UNKNOWN_ERROR)
    return Status(code, statuses_of(error).http, error.reason, error.detail)

"""Every error as google.rpc.Status, with the reason and the field that HTTP tells."""

from __future__ import annotations

import asyncio
from typing import NoReturn

import grpc
from google.protobuf.any_pb2 import Any as AnyMessage
from google.protobuf.duration_pb2 import Duration
from google.rpc.error_details_pb2 import BadRequest, ErrorInfo, RetryInfo
from google.rpc.status_pb2 import Status

from ultragray.errors import InvalidArgument, UltragrayError
from ultragray_service.errors import retry_after_s, statuses_of
from ultragray_service.telemetry.logs import request_id

ERROR_DOMAIN = "ultragray"
REQUEST_ID_KEY = "x-request-id"
_DETAILS_KEY = "grpc-status-details-bin"


def status_of(error: UltragrayError) -> Status:
    """The status, with ErrorInfo (domain, reason, metadata `field`), BadRequest and RetryInfo where apt."""
    statuses = statuses_of(error)
    code = getattr(grpc.StatusCode, statuses.grpc)
    info = ErrorInfo(reason=error.reason, domain=ERROR_DOMAIN, metadata={"field": error.field} if error.field else {})
    details = [info]
    if error.field and isinstance(error, InvalidArgument):
        violation = BadRequest.FieldViolation(field=error.field, description=error.detail)
        details.append(BadRequest(field_violations=[violation]))
    if (delay_s := retry_after_s(error)) is not None:
        details.append(RetryInfo(retry_delay=Duration(nanos=int(delay_s % 1 * 1e9), seconds=int(delay_s))))
    status = Status(code=code.value[0], message=error.detail)
    for detail in details:
        packed = AnyMessage()
        packed.Pack(detail)
        status.details.append(packed)
    return status


async def abort(context: grpc.aio.ServicerContext, error: UltragrayError) -> NoReturn:
    """Ends the call with `error`. Raises CancelledError where the caller is gone, which grpc tells a moment later."""
    details = ((_DETAILS_KEY, status_of(error).SerializeToString()), (REQUEST_ID_KEY, request_id.get()))
    try:
        await context.abort(getattr(grpc.StatusCode, statuses_of(error).grpc), error.detail, details)
    except grpc.aio.InternalError:
        raise asyncio.CancelledError from None
    raise AssertionError("abort always raises")

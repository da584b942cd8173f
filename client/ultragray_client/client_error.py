"""The base of the client's errors."""

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

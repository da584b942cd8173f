"""The base of the client's errors."""

from __future__ import annotations

import re

import grpc


class ClientError(Exception):
    """A call that failed: the stable `reason`, and `detail`, one sentence for people.

    The reason is the name of the class. None where there is none: `field` (the path of what is to blame),
    `retry_after_s` (seconds after which it may succeed), and in a stream `sequence` (of the pose that gets no frame).
    """

    reason = "INTERNAL"
    grpc_status = "INTERNAL"

    def __init_subclass__(cls) -> None:
        cls.reason = re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).upper()
        if cls.reason in grpc.StatusCode.__members__:  # the root of a branch, for the reasons that are not known here
            cls.grpc_status = cls.reason

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

    @classmethod
    def branch(cls) -> tuple[type[ClientError], ...]:
        """The class and all below it, each before those that are below it."""
        return cls, *(one for below in cls.__subclasses__() for one in below.branch())

    def __str__(self) -> str:
        return f"{self.reason}: {self.detail}"

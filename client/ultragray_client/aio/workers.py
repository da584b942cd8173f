"""The workers of a service."""

from __future__ import annotations

from ultragray_client.records import Worker, worker_from_message
from ultragray_proto.v1 import workers_pb2, workers_pb2_grpc

from .connection import AsyncConnection


class AsyncWorkers:
    """`client.workers`. All raise ClientError; a name that does not exist is WorkerNotFound.

    Only admins pause, drain and resume; the worker obeys within two seconds, and rests until `resume`, restarts
    included.
    """

    def __init__(self, connection: AsyncConnection) -> None:
        self._connection = connection
        self._calls = workers_pb2_grpc.WorkerServiceStub(connection.channel)

    async def list(self, *, timeout_s: float | None = None) -> tuple[Worker, ...]:
        """The workers by name, also those that were lost within a day."""
        request = workers_pb2.ListWorkersRequest()
        answer = await self._connection.answer(self._calls.ListWorkers, request, timeout_s)
        return tuple(map(worker_from_message, answer.workers))

    async def pause(self, name: str, *, timeout_s: float | None = None) -> Worker:
        """Lets a worker take no more jobs; it ends the one at hand."""
        request = workers_pb2.PauseWorkerRequest(worker=name)
        return worker_from_message(await self._connection.answer(self._calls.PauseWorker, request, timeout_s))

    async def drain(self, name: str, *, timeout_s: float | None = None) -> Worker:
        """As `pause`, but a training at hand goes back into the queue at once, and on elsewhere from its checkpoint."""
        request = workers_pb2.DrainWorkerRequest(worker=name)
        return worker_from_message(await self._connection.answer(self._calls.DrainWorker, request, timeout_s))

    async def resume(self, name: str, *, timeout_s: float | None = None) -> Worker:
        """Lets a worker take jobs again."""
        request = workers_pb2.ResumeWorkerRequest(worker=name)
        return worker_from_message(await self._connection.answer(self._calls.ResumeWorker, request, timeout_s))

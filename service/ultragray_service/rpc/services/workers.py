"""WorkerService."""

from __future__ import annotations

import grpc

from ultragray_proto.codec import to_message
from ultragray_proto.v1 import workers_pb2
from ultragray_service.service import Service
from ultragray_workers.jobs.queue.wishes import Wanted
from ultragray_workers.jobs.store import JobStore


class WorkerService:
    """The methods of ultragray.v1.WorkerService."""

    def __init__(self, service: Service) -> None:
        self._service = service

    async def ListWorkers(  # noqa: N802
        self, request: workers_pb2.ListWorkersRequest, context: grpc.aio.ServicerContext
    ) -> workers_pb2.ListWorkersResponse:
        return to_message(await self._service.jobs.workers(), workers_pb2.ListWorkersResponse)

    async def PauseWorker(  # noqa: N802
        self, request: workers_pb2.PauseWorkerRequest, context: grpc.aio.ServicerContext
    ) -> workers_pb2.Worker:
        return await self._want(request.worker, Wanted.PAUSE)

    async def DrainWorker(  # noqa: N802
        self, request: workers_pb2.DrainWorkerRequest, context: grpc.aio.ServicerContext
    ) -> workers_pb2.Worker:
        return await self._want(request.worker, Wanted.DRAIN)

    async def ResumeWorker(  # noqa: N802
        self, request: workers_pb2.ResumeWorkerRequest, context: grpc.aio.ServicerContext
    ) -> workers_pb2.Worker:
        return await self._want(request.worker, Wanted.WORK)

    async def _want(self, worker: str, wanted: Wanted) -> workers_pb2.Worker:
        return to_message(await self._service.jobs.do(JobStore.want, worker, wanted), workers_pb2.Worker)

"""The gRPC server: our services, health and reflection."""

from __future__ import annotations

import grpc
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from ultragray_proto.v1 import (
    datasets_pb2,
    datasets_pb2_grpc,
    jobs_pb2,
    jobs_pb2_grpc,
    rendering_pb2,
    rendering_pb2_grpc,
    scenes_pb2,
    scenes_pb2_grpc,
)

from ..core.state import Service
from .datasets import DatasetService
from .interceptor import CallContext
from .jobs import JobService
from .rendering import RenderService
from .scenes import SceneService

MAX_RECEIVE_BYTES = 16 * 2**20
LEAST_PING_INTERVAL_MS = 10_000
_UNLIMITED = -1

SERVICE_NAMES = (
    scenes_pb2.DESCRIPTOR.services_by_name["SceneService"].full_name,
    rendering_pb2.DESCRIPTOR.services_by_name["RenderService"].full_name,
    datasets_pb2.DESCRIPTOR.services_by_name["DatasetService"].full_name,
    jobs_pb2.DESCRIPTOR.services_by_name["JobService"].full_name,
)


class GrpcServer:
    """A server that listens once started, and tells its health."""

    def __init__(self, service: Service) -> None:
        self._server = grpc.aio.server(
            interceptors=[CallContext(service.guard, service.metrics)],
            options=[
                ("grpc.max_receive_message_length", MAX_RECEIVE_BYTES),
                ("grpc.max_send_message_length", _UNLIMITED),
                # A client may ask this often whether the service is still there, as in a quiet WatchJob; without it, a
                # client that asks more than twice within five minutes is cut off.
                ("grpc.http2.min_ping_interval_without_data_ms", LEAST_PING_INTERVAL_MS),
                ("grpc.so_reuseport", 0),  # else a second service would share the port unnoticed
            ],
        )
        self._health = health.aio.HealthServicer()
        rendering_pb2_grpc.add_RenderServiceServicer_to_server(RenderService(service), self._server)
        scenes_pb2_grpc.add_SceneServiceServicer_to_server(SceneService(service), self._server)
        datasets_pb2_grpc.add_DatasetServiceServicer_to_server(DatasetService(service), self._server)
        jobs_pb2_grpc.add_JobServiceServicer_to_server(JobService(service), self._server)
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)
        reflection.enable_server_reflection(
            (*SERVICE_NAMES, health.SERVICE_NAME, reflection.SERVICE_NAME), self._server
        )

    def bind(self, host: str, port: int) -> int:
        """Takes the port (0: a free one) and returns it. Raises RuntimeError where it is in use."""
        address = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        return int(self._server.add_insecure_port(address))

    async def start(self) -> None:
        """Begins to answer; health says NOT_SERVING until told otherwise."""
        await self.tell_health(serving=False)
        await self._server.start()

    async def tell_health(self, *, serving: bool) -> None:
        """Sets the answer of grpc.health.v1 from now on."""
        code = health_pb2.HealthCheckResponse.SERVING if serving else health_pb2.HealthCheckResponse.NOT_SERVING
        for name in ("", *SERVICE_NAMES):
            await self._health.set(name, code)

    async def stop(self, grace_s: float) -> None:
        """Refuses new calls and gives those that run `grace_s` seconds."""
        await self._server.stop(grace_s)

"""The gRPC server: our services, health and reflection."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import grpc
from google.protobuf.descriptor import MethodDescriptor
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from ultragray_proto.codec import to_message
from ultragray_proto.v1 import (
    access_pb2,
    datasets_pb2,
    jobs_pb2,
    recordings_pb2,
    registrations_pb2,
    rendering_pb2,
    scenes_pb2,
    workers_pb2,
)
from ultragray_service.access.rules import require_all_methods
from ultragray_service.core.readiness import Readiness
from ultragray_service.rpc.calls import CallContext, make_handler
from ultragray_service.rpc.rendering import RenderService
from ultragray_service.rpc.resources import CALLS, STREAMS
from ultragray_service.service import Service
from ultragray_service.settings import Settings
from ultragray_service.tls import HANDSHAKE_TIMEOUT_S, Certificates, CertificateWatch

LEAST_MAX_MESSAGE_BYTES = 2 * 2**20  # room for a chunk of an upload
LEAST_PING_INTERVAL_MS = 10_000
MAX_CALLS_PER_CONNECTION = 1024
_UNLIMITED = -1

_FILES = (scenes_pb2, rendering_pb2, datasets_pb2, jobs_pb2, access_pb2, workers_pb2, registrations_pb2, recordings_pb2)
_DESCRIPTORS = {name: one for file in _FILES for name, one in file.DESCRIPTOR.services_by_name.items()}
SERVICE_NAMES = tuple(one.full_name for one in _DESCRIPTORS.values())


def _handler(service: Service, rendering: RenderService, method: MethodDescriptor) -> grpc.RpcMethodHandler:
    answer_class: Any = GetMessageClass(method.output_type)
    name = f"{method.containing_service.name}.{method.name}"

    async def call(request: Any, context: Any) -> Any:
        answer = await CALLS[name](service, request)
        if isinstance(answer, Message):
            return answer
        return answer_class(**answer) if isinstance(answer, Mapping) else to_message(answer, answer_class)

    if name in CALLS:
        run: Any = call
    else:
        run = partial(STREAMS[name], service) if name in STREAMS else getattr(rendering, method.name)
    streaming = method.client_streaming, method.server_streaming
    return make_handler(streaming, run, GetMessageClass(method.input_type).FromString, _bytes_of)


def _bytes_of(answer: Message | bytes) -> bytes:
    """An answer as it is sent: frames come as bytes already."""
    return answer if isinstance(answer, bytes) else answer.SerializeToString()


class GrpcServer:
    def __init__(self, service: Service) -> None:
        require_all_methods(
            f"/{one.full_name}/{method.name}" for one in _DESCRIPTORS.values() for method in one.methods
        )
        self._server = grpc.aio.server(
            interceptors=[CallContext(service)],
            options=[
                ("grpc.max_receive_message_length", max(service.settings.max_body_bytes, LEAST_MAX_MESSAGE_BYTES)),
                ("grpc.max_send_message_length", _UNLIMITED),
                # A client may ask this often whether the service is still there, as in a quiet WatchJob; without it, a
                # client that asks more than twice within five minutes is cut off.
                ("grpc.http2.min_ping_interval_without_data_ms", LEAST_PING_INTERVAL_MS),
                ("grpc.server_handshake_timeout_ms", round(1000 * HANDSHAKE_TIMEOUT_S)),
                ("grpc.so_reuseport", 0),  # else a second service would share the port unnoticed
                *_connection_options(service.settings),
            ],
        )
        self._health = Health()
        self._states = dict.fromkeys(("", *SERVICE_NAMES), False)
        rendering = RenderService(service)
        for one in _DESCRIPTORS.values():
            handlers = {method.name: _handler(service, rendering, method) for method in one.methods}
            self._server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(one.full_name, handlers),))
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)
        reflection.enable_server_reflection(
            (*SERVICE_NAMES, health.SERVICE_NAME, reflection.SERVICE_NAME), self._server
        )

    def bind(self, host: str, port: int, certificates: CertificateWatch | None) -> int:
        address = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        if certificates is None:
            return int(self._server.add_insecure_port(address))
        return int(self._server.add_secure_port(address, _credentials(certificates)))

    async def start(self) -> None:
        """Begins to answer; health says NOT_SERVING until told otherwise."""
        for name in self._states:
            await self._health.set(name, health_pb2.HealthCheckResponse.NOT_SERVING)
        await self._server.start()

    async def tell_health(self, readiness: Readiness) -> None:
        parts = readiness.components
        serving = {
            "RenderService": parts.frames.ready,
            "SceneService": parts.frames.ready,
            "DatasetService": parts.artifacts.ready,
            "RecordingService": parts.artifacts.ready,
            "JobService": parts.jobs.ready and parts.artifacts.ready,
            "WorkerService": parts.jobs.ready,
            "AccessService": True,
            "RegistrationService": parts.jobs.ready,
        }
        states = {_DESCRIPTORS[name].full_name: is_serving for name, is_serving in serving.items()}
        for name, is_serving in {"": readiness.problem is None, **states}.items():
            if self._states[name] is not is_serving:
                self._states[name] = is_serving
                code = health_pb2.HealthCheckResponse
                await self._health.set(name, code.SERVING if is_serving else code.NOT_SERVING)

    async def stop(self, grace_s: float) -> None:
        await self._server.stop(grace_s)


def _credentials(certificates: CertificateWatch) -> grpc.ServerCredentials:
    """Credentials that are those of `certificates` at the time of each handshake."""
    offered = certificates.current

    def fetch() -> grpc.ServerCertificateConfiguration | None:
        nonlocal offered
        if certificates.current is offered:
            return None  # grpc keeps what it has
        offered = certificates.current
        return _configuration(offered)

    return grpc.dynamic_ssl_server_credentials(
        _configuration(offered), fetch, require_client_authentication=offered.content.client_authorities is not None
    )


def _configuration(certificates: Certificates) -> grpc.ServerCertificateConfiguration:
    content = certificates.content
    return grpc.ssl_server_certificate_configuration([(content.key, content.chain)], content.client_authorities)


def _connection_options(settings: Settings) -> list[tuple[str, int]]:
    """The bounds of connections as gRPC calls them; those of one address are OpenSockets' to keep."""
    return [
        ("grpc.max_allowed_incoming_connections", settings.max_connections),
        ("grpc.max_concurrent_streams", MAX_CALLS_PER_CONNECTION),
        ("grpc.max_metadata_size", settings.max_header_bytes),
        ("grpc.absolute_max_metadata_size", settings.max_header_bytes),
        ("grpc.max_connection_idle_ms", round(1000 * settings.idle_timeout_s)),
        # Pings find clients that vanished, and those that read nothing any more.
        ("grpc.keepalive_time_ms", round(1000 * settings.idle_timeout_s)),
        ("grpc.keepalive_timeout_ms", round(1000 * settings.transfer_patience_s)),
    ]


class Health(health.aio.HealthServicer):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__()
        self._statuses: dict[str, Any] = {}

    async def set(self, service: str, status: Any) -> None:
        self._statuses[service] = status
        await super().set(service, status)

    async def List(self, request: Any, context: Any) -> Any:  # the name of the method
        statuses = {name: health_pb2.HealthCheckResponse(status=status) for name, status in self._statuses.items()}
        return health_pb2.HealthListResponse(statuses=statuses)

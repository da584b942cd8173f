"""A replica in a process of its own, whose frames are of 1 x 1 pixel: `python echo_replica.py`; it prints its ports."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from concurrent import futures
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import grpc
from grpc_health.v1 import health, health_pb2, health_pb2_grpc

from ultragray_proto.v1 import geometry_pb2, rendering_pb2, rendering_pb2_grpc


class Renders(rendering_pb2_grpc.RenderServiceServicer):  # type: ignore[misc]
    """Answers each pose with its place along x as the pixel."""

    def RenderStream(self, messages: Any, context: grpc.ServicerContext) -> Iterator[rendering_pb2.Frame]:  # noqa: N802
        for message in messages:
            if message.HasField("pose"):
                x = message.pose.matrix.values[3]
                yield rendering_pb2.Frame(
                    sequence=message.sequence,
                    outputs=[rendering_pb2.OUTPUT_BMODE],
                    encoding=rendering_pb2.ENCODING_UINT8,
                    height=1,
                    width=1,
                    data=bytes([int(x)]),
                    pose=message.pose.matrix,
                    probe=geometry_pb2.Probe(linear=geometry_pb2.LinearProbe(width_mm=1, far_mm=1)),
                    timings=rendering_pb2.Timings(),
                    extrapolation=rendering_pb2.Extrapolation(),
                    picture=rendering_pb2.Picture(),
                    client_time_ns=message.client_time_ns,
                )


class Ready(BaseHTTPRequestHandler):
    """Is always ready."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("content-length", "0")
        self.end_headers()

    def log_message(self, *_: object) -> None:
        """Nothing."""


if __name__ == "__main__":
    http = ThreadingHTTPServer(("127.0.0.1", 0), Ready)
    threading.Thread(target=http.serve_forever, daemon=True).start()
    server = grpc.server(futures.ThreadPoolExecutor(32))
    rendering_pb2_grpc.add_RenderServiceServicer_to_server(Renders(), server)
    service_health = health.HealthServicer()
    health_pb2_grpc.add_HealthServicer_to_server(service_health, server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    service_health.set("", health_pb2.HealthCheckResponse.SERVING)
    sys.stdout.write(f"{http.server_address[1]} {port}\n")
    sys.stdout.flush()
    server.wait_for_termination()

"""Parts about limits that no setting changes: each row names the constant that holds it."""

from __future__ import annotations

from ultragray.geometry import image_size, pose, probe
from ultragray.geometry import probe as fan
from ultragray.rendering.tools import MAX_TOOLS
from ultragray.scene import info as scene_info
from ultragray_service.core import scenes as catalog
from ultragray_service.core import streams as pose_stream
from ultragray_service.core import uploads as dataset_uploads
from ultragray_service.errors import STATUSES
from ultragray_service.http import protocol as http_server
from ultragray_service.igtl import connection
from ultragray_service.igtl import frames as waiting
from ultragray_service.rpc import server as grpc_server
from ultragray_service.rpc import shared_memory
from ultragray_service.settings import LEAST_KEY_LENGTH
from ultragray_service.tls.server import HANDSHAKE_TIMEOUT_S
from ultragray_workers import scene_names
from ultragray_workers.datasets import store as dataset_store
from ultragray_workers.datasets import unpack as dataset_unpack
from ultragray_workers.pool import pixels as encoding

from .markdown import code, table

_HEAD = ("Limit", "Value")


def fixed() -> str:
    rows = [
        ("Name of a scene", code(scene_names._NAME.pattern)),
        ("Name of a dataset", code(dataset_store._NAME.pattern)),
        ("Deviation from a rotation that is corrected", f"{pose.ROTATION_TOLERANCE:g}"),
        ("Coordinate of a pose", f"{pose.MAX_POSITION_MM:,.0f} mm"),
        ("Length of a probe", f"{probe.MAX_LENGTH_MM:,.0f} mm"),
        ("Tools of a frame", f"{MAX_TOOLS}"),
        ("Opening angle of a fan", f"{fan.LARGEST_OPENING_DEG:g}°"),
        ("Height and width of a frame (library)", f"{image_size.MAX_IMAGE_SIDE:,}"),
        ("Height and width if the scene does not know them", f"{image_size.DEFAULT_IMAGE_SIDE:,}"),
        ("Training poses of a scene", f"{scene_info.MAX_TRAINING_POSES:,}"),
        ("Header of a scene file, metadata included", _bytes(scene_info.MAX_HEADER_BYTES)),
        ("Metrics of a scene", f"{scene_info.MAX_METRICS:,}"),
        ("Degree of the spherical harmonics", f"{scene_info.MAX_SH_DEGREE}"),
        ("Entries on one page of a list", f"{catalog.MAX_PAGE_SIZE:,}, by default {catalog.DEFAULT_PAGE_SIZE}"),
        ("Uploads at the same time", f"{dataset_uploads.MAX_UPLOADS}"),
        ("Files of a dataset", f"{dataset_unpack.MAX_FILES:,}"),
        ("Time to check a dataset", f"{dataset_uploads.CHECK_TIMEOUT_S:,} s"),
        ("Frames in flight in an ordered stream", f"{pose_stream.MAX_FRAMES_IN_FLIGHT}"),
        ("Their bytes, if there are several", _bytes(pose_stream.MAX_BYTES_IN_FLIGHT)),
        ("Window of a latest stream", f"{pose_stream.MAX_WINDOW} frames"),
        ("Memory that a stream shares", _bytes(shared_memory.MAX_BYTES)),
        ("Message to the WebSocket", _bytes(http_server.MAX_STREAM_MESSAGE_BYTES)),
        ("gRPC message, if `ULTRAGRAY_MAX_BODY_BYTES` is less", _bytes(grpc_server.LEAST_MAX_MESSAGE_BYTES)),
        ("Time between keepalive pings of a gRPC client, at least", f"{grpc_server.LEAST_PING_INTERVAL_MS:,} ms"),
        ("TLS handshake", f"{HANDSHAKE_TIMEOUT_S:g} s"),
        ("Quality of a JPEG", f"{encoding.JPEG_QUALITY}"),
        ("`Retry-After` of a full queue", f"{STATUSES['QUEUE_FULL'].retry_after_s:g} s"),
        ("Length of an API key, at least", f"{LEAST_KEY_LENGTH} characters"),
    ]
    return table(_HEAD, rows)


def igtl() -> str:
    rows = [
        ("Devices of a client that wait for their frames", f"{waiting.MAX_WAITING_DEVICES}"),
        ("Content of a message that is read", _bytes(connection.MAX_BODY_BYTES)),
        ("Content of any message; more is skipped", _bytes(connection.MAX_SKIPPED_BYTES)),
        ("Time from the first byte of a message to its last", f"{connection.MESSAGE_TIMEOUT_S:g} s"),
        ("Time that a client may take nothing", f"{connection.SEND_TIMEOUT_S:g} s"),
    ]
    return table(_HEAD, rows)


def _bytes(number: int) -> str:
    for unit, size in (("MiB", 2**20), ("KiB", 2**10)):
        if number % size == 0:
            return f"{number // size:,} {unit}"
    return f"{number:,} bytes"

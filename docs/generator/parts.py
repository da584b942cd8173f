"""What pages may ask for with `<!-- generated: NAME -->`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from ultragray.rendering.display import Display
from ultragray.rendering.settings import RenderSettings
from ultragray.rendering.volumes import SliceSettings
from ultragray.scene.confidence import Extrapolation
from ultragray.scene.info import SceneInfo
from ultragray_service.http.bodies import RenderBody, StreamMessage
from ultragray_service.http.routes.streams import FrameMessage
from ultragray_studies.gym.standard_plane import StandardPlaneSettings

from . import command_line, grpc_api, http_api, library, limits, python_api, service

PARTS: dict[str, Callable[[], str]] = {
    "outputs": library.outputs,
    "formats": library.formats,
    "npz": library.npz,
    "samplers": library.samplers,
    "methods": library.methods,
    "training settings": library.training_settings,
    "scene metadata": partial(library.keys, SceneInfo),
    "display": partial(library.keys, Display, "Setting"),
    "standard plane": partial(library.keys, StandardPlaneSettings, "Argument"),
    "confidence": partial(library.told, Extrapolation, "Figure"),
    "render body": partial(library.keys, RenderBody),
    "slice body": partial(library.keys, SliceSettings),
    "stream messages": partial(library.keys, StreamMessage),
    "stream settings": partial(library.keys, RenderSettings),
    "stream frames": partial(library.told, FrameMessage),
    "settings": service.settings,
    "errors": service.error_reasons,
    "client errors": service.client_error_reasons,
    "metrics": service.metrics,
    "limits": limits.fixed,
    "OpenIGTLink limits": limits.igtl,
    "routes": http_api.routes,
    "render headers": http_api.render_headers,
    "objects": http_api.objects,
    "services": grpc_api.services,
    "messages": grpc_api.messages,
    "enums": grpc_api.enums,
    "commands": command_line.commands,
    "library": partial(python_api.package, "ultragray"),
    "library modules": python_api.modules,
    "client": partial(python_api.package, "ultragray_client"),
    "client groups": python_api.client_groups,
}

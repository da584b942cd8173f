"""docs/interfaces.md lists every public name; one that is new, renamed or gone fails here until it says so."""

from __future__ import annotations

import dataclasses
import inspect
import io
import json
import logging
import math
import re
import sys
import typing
from dataclasses import asdict, fields
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import typer
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from safetensors import safe_open

import ultragray
import ultragray_client
from ultragray import (
    ConvexProbe,
    GaussianScene,
    LinearProbe,
    PhasedProbe,
    SceneInfo,
    baselines,
    checkpoint,
    checkpoint_export,
    compounding,
    confidence,
    demo,
    display,
    display_frames,
    errors,
    evaluation,
    exports,
    files,
    metrics,
    ply,
    pose,
    pose_file,
    probe,
    rendering,
    request,
    samplers,
    scene_info,
    side_by_side,
)
from ultragray.confidence import Extrapolation
from ultragray.datasets import Dataset, Sweep, checks, phantom, pictures, plus, released, source
from ultragray.display import AS_RENDERED
from ultragray.training import TrainingConfig
from ultragray_client.sync import datasets as client_datasets
from ultragray_client.sync import jobs as client_jobs
from ultragray_client.sync import scenes as client_scenes
from ultragray_proto.v1 import datasets_pb2, geometry_pb2, jobs_pb2, rendering_pb2, scenes_pb2
from ultragray_service import catalog, dataset_uploads, pose_stream, server
from ultragray_service.cli import USER_ERROR
from ultragray_service.cli import app as command_line
from ultragray_service.cli_jobs_watch import JOB_CANCELLED, JOB_FAILED
from ultragray_service.cli_train import INTERRUPTED
from ultragray_service.http import accept, middleware, problems
from ultragray_service.http.app import create_app
from ultragray_service.http.docs import DOCS_PATH
from ultragray_service.http.routes import render as render_route
from ultragray_service.http.schemas import DisplayBody, RenderBody
from ultragray_service.http.stream_schemas import StreamMessage, StreamSettings, frame_bytes
from ultragray_service.logs import JsonFormatter, request_id
from ultragray_service.pose_stream import Answered
from ultragray_service.rpc import server as grpc_server
from ultragray_service.rpc import status
from ultragray_service.settings import ENVIRONMENT_PREFIX, Settings, load_settings
from ultragray_service.state import Service
from ultragray_workers import dataset_store, dataset_unpack, scenes
from ultragray_workers import encoding as pixels
from ultragray_workers.jobs.job import JobState
from ultragray_workers.types import Encoding, RenderResult

DOCUMENT = (Path(__file__).resolve().parents[1] / "docs" / "interfaces.md").read_text(encoding="utf-8")
PROTO_MODULES = (geometry_pb2, rendering_pb2, scenes_pb2, datasets_pb2, jobs_pb2)
LIBRARY_MODULES = (
    checkpoint,
    checkpoint_export,
    demo,
    display,
    display_frames,
    files,
    ply,
    pose,
    pose_file,
    probe,
    rendering,
)
MEASURING_MODULES = (baselines, compounding, evaluation, metrics, side_by_side)
MEMBERS_OF = (GaussianScene, LinearProbe, ConvexProbe, PhasedProbe, errors.UltragrayError)

LABELS = torch.ones(5, dtype=torch.uint8)


def rows(heading: str) -> list[list[str]]:
    """The cells of the table below a heading of the document, without the table's own head."""
    _, *below = re.split(rf"^#+ {re.escape(heading)}$", DOCUMENT, maxsplit=1, flags=re.MULTILINE)
    section = re.split(r"^#+ ", "".join(below), maxsplit=1, flags=re.MULTILINE)[0]
    lines = [line.strip("|") for line in section.splitlines() if line.startswith("|")]
    assert lines, f"the document has no table under {heading!r}"
    return [[cell.strip() for cell in line.split("|")] for line in lines[2:]]


def code(cell: str) -> list[str]:
    """What a cell writes in backticks."""
    return re.findall(r"`([^`]+)`", cell)


def table(heading: str) -> dict[str, list[str]]:
    """The rows under a heading, by the name in backticks that each begins with."""
    named = [(code(first)[0], rest) for first, *rest in rows(heading)]
    found = dict(named)
    assert len(found) == len(named), f"a name comes twice under {heading!r}"
    return found


def numbers(cell: str) -> list[float]:
    return [float(number) for number in re.findall(r"\d+(?:\.\d+)?(?:e-?\d+)?", cell)]


@pytest.fixture
def service(tmp_path: Path) -> Service:
    return Service(Settings(data_folder=tmp_path))


@pytest.fixture
def openapi(service: Service) -> dict[str, Any]:
    return create_app(service).openapi()


# Python library


def call_of(value: Any) -> str:
    """`name(parameters, with=defaults)` of a function or class."""
    parts: list[str] = []
    for parameter in inspect.signature(value).parameters.values():
        if parameter.kind is parameter.KEYWORD_ONLY and "*" not in parts:
            parts.append("*")
        default = "" if parameter.default is parameter.empty else f"={parameter.default!r}"
        parts.append(parameter.name + default.replace("<factory>", "…"))
    return f"{value.__name__}({', '.join(parts)})"


def test_library() -> None:
    calls = {name: getattr(ultragray, name) for name in ultragray.__all__}
    assert set(table("Python library")) == {
        call_of(value) if hasattr(value, "__name__") and callable(value) else name for name, value in calls.items()
    }


def test_members() -> None:
    public = {
        f"{cls.__name__}.{name}"
        for cls in MEMBERS_OF
        for name in set(dir(cls)) - set(dir(Exception)) - set(inspect.signature(cls).parameters)
        if not name.startswith("_")
    }
    assert set(table("Members")) == public


def test_other_modules() -> None:
    found = {
        f"{module.__name__}.{call_of(value)}"
        for module in (*LIBRARY_MODULES, *MEASURING_MODULES, checks, pictures, plus, released, source)
        for name, value in vars(module).items()
        if inspect.isfunction(value) and value.__module__ == module.__name__
        if not name.startswith("_") and name not in ultragray.__all__
    }
    found |= {
        f"{phantom.__name__}.{call_of(value)}"
        for value in (getattr(phantom, name) for name in phantom.__all__)
        if inspect.isfunction(value)
    }
    found |= {
        f"{package.__name__}.{call_of(value)}"
        for package in (samplers, exports)
        for value in (getattr(package, name) for name in package.__all__)
        if inspect.isfunction(value)
    }
    found |= {
        f"{confidence.__name__}.{call_of(value)}"
        for value in (getattr(confidence, name) for name in confidence.__all__)
        if callable(value)
    }
    assert set(table("Other modules")) == found


def test_samplers() -> None:
    documented = {}
    for kind, (keys, _) in table("Samplers").items():
        parts = [code(part) for part in keys.split(",")] if keys else []
        documented[kind] = {name: json.loads(default[0]) if default else "required" for name, *default in parts}
    assert documented == {
        kind: {
            item.name: "required" if item.default is dataclasses.MISSING else item.default
            for item in dataclasses.fields(cls)
        }
        for kind, cls in samplers.SAMPLERS.items()
    }


def test_export_formats() -> None:
    documented = {
        name: (code(suffix)[0], tuple(code(pixels)), (code(extra) or [None])[0])
        for name, (suffix, pixels, extra, _) in table("Export formats").items()
    }
    assert documented == {name: (one.suffix, one.dtypes, one.extra) for name, one in exports.FORMATS.items()}


def test_dataset_configuration(tmp_path: Path) -> None:
    images = np.arange(2 * 3 * 4, dtype=np.uint8).reshape(2, 3, 4)
    found: set[str] = set()
    for number, one in enumerate((LinearProbe(40, 0, 50), PhasedProbe(60, 50))):
        sweep = Sweep(images, np.tile(np.eye(4), (2, 1, 1)), one, np.arange(2), "here")
        released.write_released(Dataset("name", sweep, sweep), tmp_path / str(number))
        found |= set(json.loads((tmp_path / str(number) / "conf.json").read_text()))
    assert set(table("Dataset configuration")) == {key for key in found if not key.startswith("_")}


# Scene file and frames


def documented_arrays(heading: str, sizes: dict[str, int]) -> dict[str, tuple[str, list[int]]]:
    """Type and shape of each row, the letters of the shape replaced by sizes."""
    return {
        name: (code(kind)[0], [sizes.get(size) or int(size) for size in re.findall(r"[\w-]+", code(shape)[0])])
        for name, (kind, shape, _) in table(heading).items()
    }


def test_scene_file(tmp_path: Path) -> None:
    shapes = scene_info.expected_shapes(5, 1)
    splats = {name: torch.ones(shape) for name, shape in shapes.items()}
    poses = np.tile(np.eye(4), (2, 1, 1))
    GaussianScene.from_splats(splats, training_poses=poses, labels=LABELS).save(tmp_path / "scene.ugr")
    with safe_open(tmp_path / "scene.ugr", framework="numpy") as bundle:
        parts = {name: bundle.get_slice(name) for name in bundle.keys()}  # noqa: SIM118 (no mapping)
        found = {name: (part.get_dtype(), list(part.get_shape())) for name, part in parts.items()}
        assert set(bundle.metadata()) == {"ultragray"}
    assert documented_arrays("Tensors", {"N": 5, "K-1": 3, "P": 2}) == found
    defaults = {**json.loads(scene_info.info_to_json(SceneInfo())), "label_names": {}}  # where empty, it is left out
    assert {key: json.loads(code(default)[0]) for key, (default, _) in table("Metadata keys").items()} == defaults


def test_ply_file(tmp_path: Path) -> None:
    splats = {name: torch.ones(shape) for name, shape in scene_info.expected_shapes(5, 1).items()}
    ply.write_ply(GaussianScene.from_splats(splats, labels=LABELS), tmp_path / "scene.ply")
    header = (tmp_path / "scene.ply").read_bytes().split(b"end_header")[0].decode()
    element, found = "", []
    for line in header.splitlines():
        match line.split():
            case ["element", name, _]:
                element = name
            case ["property", kind, name]:
                found.append((name, element, kind))
    documented = [
        (name, code(element)[0], code(kind)[0]) for names, element, kind, _ in rows("PLY file") for name in code(names)
    ]
    assert documented == found


def test_exported_checkpoint(tmp_path: Path) -> None:
    splats = {name: torch.ones(shape) for name, shape in scene_info.expected_shapes(5, 1).items()}
    info = SceneInfo(probe=PhasedProbe(60, 50))
    scene = GaussianScene.from_splats(splats, info=info, training_poses=np.eye(4)[None])
    written = checkpoint_export.export_checkpoint(scene, tmp_path / "ckpt_29999.pt").files
    documented = table("Exported checkpoint")
    assert set(documented) == {path.name for path in written}
    assert code(documented["ckpt_29999.pt"][0]) == list(torch.load(tmp_path / "ckpt_29999.pt", weights_only=True))
    keys = set(code(documented["conf.json"][0]))
    assert keys == {*json.loads((tmp_path / "conf.json").read_text()), "ultrasound_opening_width"}


def test_frames() -> None:
    assert list(table("Outputs")) == list(request.ALL_OUTPUTS)
    documented = {name: code(media_type)[0] for name, (media_type, _) in table("Encodings").items()}
    assert set(documented) == {encoding.value for encoding in Encoding}
    for name, media_type in documented.items():
        dtype = name if media_type == accept.RAW else None
        assert accept.choose(media_type, frames=1, outputs=1, dtype=dtype).encoding is Encoding(name)


def test_npz() -> None:
    file = io.BytesIO()
    frames = {name: np.zeros((2, 3, 5), np.float32) for name in request.ALL_OUTPUTS}
    told = [Extrapolation(None, None, None, None)] * 2
    pixels.write_npz(file, frames, np.zeros((2, 4, 4)), told, scene="demo", scene_sha256="0" * 64, renderer="ultragray")
    file.seek(0)
    with np.load(file) as archive:
        found = {
            name: ("str" if array.dtype.kind == "U" else array.dtype.name, list(array.shape))
            for name, array in archive.items()
        }
    assert documented_arrays("npz keys", {"C": 2, "H": 3, "W": 5}) == found


# HTTP


def test_routes(service: Service, openapi: dict[str, Any]) -> None:
    found = {
        f"{method.upper()} {path}": sorted(map(int, operation["responses"]))
        for path, operations in openapi["paths"].items()
        for method, operation in operations.items()
    }
    app = create_app(service)
    found |= {f"GET {path}": [200] for path in (DOCS_PATH, app.openapi_url)}
    assert {name: [int(n) for n in numbers(statuses)] for name, (statuses, _) in table("Routes").items()} == found


def test_query_parameters(openapi: dict[str, Any]) -> None:
    found = {
        parameter["name"]: parameter["schema"]["default"]
        for operations in openapi["paths"].values()
        for operation in operations.values()
        for parameter in operation.get("parameters", ())
        if parameter["in"] == "query"
    }
    documented = {name: cell for name, (cell, _) in table("Query parameters").items()}
    assert documented == {name: f"`{value}`" if value else "empty" for name, value in found.items()}


@pytest.mark.parametrize(
    ("heading", "model"), [("Stream messages", StreamMessage), ("Stream settings", StreamSettings)]
)
def test_stream_messages(heading: str, model: type[BaseModel]) -> None:
    documented = {key: json.loads(code(default)[0]) for key, (default, _) in table(heading).items()}
    assert documented == {key: field.default for key, field in model.model_fields.items()}


def test_display_settings() -> None:
    documented = {key: json.loads(code(default)[0]) for key, (default, _) in table("Display settings").items()}
    assert documented == {**asdict(AS_RENDERED), "tgc_db": []}
    assert documented == DisplayBody().model_dump()


def test_confidence() -> None:
    assert list(table("Confidence")) == [figure.name for figure in fields(Extrapolation)]


def test_stream_frames(rendered: RenderResult) -> None:
    message = frame_bytes(Answered(0, None, rendered), rendered)
    header = json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")])
    assert list(header) == list(table("Stream frames"))


def test_bodies(openapi: dict[str, Any]) -> None:
    schemas = openapi["components"]["schemas"]
    body = schemas.pop("RenderBody")["properties"]
    documented = {key: json.loads(code(default)[0]) for key, (default, _) in table("Render body").items()}
    assert documented == {key: value.get("default") for key, value in body.items()}
    objects = {name: list(schema["properties"]) for name, schema in schemas.items()}
    assert {name: code(keys) for name, (keys, _) in table("Objects").items()} == objects


def test_accept_types() -> None:
    assert list(table("Accept")) == list(accept.MEDIA_TYPES)


def test_request_headers() -> None:
    # Read one by one where they are needed, so that no list of them exists; the rest of the suite sends each.
    sent = {"Accept", "Content-Type", "Authorization", "X-API-Key", middleware.REQUEST_ID_HEADER}
    assert set(table("Request headers")) == sent


@pytest.fixture
def rendered() -> RenderResult:
    return RenderResult(
        scene="demo",
        scene_sha256="0" * 64,
        renderer="ultragray",
        poses=np.eye(4)[None],
        probe=LinearProbe(40, 0, 50),
        rendered_height=1,
        rendered_width=1,
        display=AS_RENDERED,
        picture=AS_RENDERED.picture(LinearProbe(40, 0, 50), 1, 1),
        outputs=("bmode",),
        encoding=Encoding.UINT8,
        data=b"\0",
        queue_ms=0.0,
        render_ms=0.0,
        encode_ms=0.0,
        extrapolations=(Extrapolation(None, None, None, None),),
        batch_size=1,
    )


def test_render_headers(rendered: RenderResult) -> None:
    sent = {*render_route._headers(rendered), middleware.REQUEST_ID_HEADER}
    assert set(table("Render headers")) == sent == set(render_route.RENDER_HEADERS)


def test_error_headers() -> None:
    answers = [problems.problem_response(cls("no")) for cls in all_errors()]
    own = {name for answer in answers for name in answer.headers} - {"content-type", "content-length"}
    assert {name.lower() for name in table("Error headers")} == own | {"allow"}  # Allow is the framework's


def test_example_bodies() -> None:
    examples = re.findall(r"-d '(\{.*?\})'", DOCUMENT, flags=re.DOTALL)
    assert examples
    for example in examples:
        RenderBody.model_validate_json(example)


# gRPC


def declarations(message: DescriptorProto) -> list[str]:
    """The fields of a message as a .proto file writes them."""
    maps = {entry.name: entry for entry in message.nested_type if entry.options.map_entry}
    written = []
    for field in message.field:
        kind = type_name(field)
        label = "optional " if field.proto3_optional else ""
        if kind in maps:
            kind = f"map<{', '.join(type_name(part) for part in maps[kind].field)}>"
        elif field.label == FieldDescriptorProto.LABEL_REPEATED:
            label = "repeated "
        written.append(f"{label}{kind} {field.name} = {field.number}")
    return written


def type_name(field: FieldDescriptorProto) -> str:
    return field.type_name.rpartition(".")[2] or FieldDescriptorProto.Type.Name(field.type).lower()[len("type_") :]


def test_messages() -> None:
    found = {}
    for module in PROTO_MODULES:
        for name, descriptor in module.DESCRIPTOR.message_types_by_name.items():
            message = DescriptorProto()
            descriptor.CopyToProto(message)
            found[name] = declarations(message)
    assert {name: code(fields) for name, (fields,) in table("Messages").items()} == found


def test_enums() -> None:
    found = {
        name: [f"{value.name} = {value.number}" for value in enum.values]
        for module in PROTO_MODULES
        for name, enum in module.DESCRIPTOR.enum_types_by_name.items()
    }
    assert {name: code(values) for name, (values,) in table("Enums").items()} == found


def test_methods() -> None:
    def side(name: str, streaming: bool) -> str:
        return f"stream {name}" if streaming else name

    found = {
        f"{service.name}.{method.name}": (
            side(method.input_type.name, method.client_streaming),
            side(method.output_type.name, method.server_streaming),
        )
        for module in PROTO_MODULES
        for service in module.DESCRIPTOR.services_by_name.values()
        for method in service.methods
    }
    assert {name: (code(taken)[0], code(given)[0]) for name, (taken, given) in table("Methods").items()} == found


def test_error_details() -> None:
    told = [status.status_of(cls("no", field="x")) for cls in all_errors()]
    found = {detail.type_url.rpartition("/")[2] for one in told for detail in one.details}
    assert set(table("Error details")) == found


def test_call_metadata() -> None:
    assert set(table("Call metadata")) == {"authorization", "x-api-key", status.REQUEST_ID_KEY}


# Python client


def test_python_client() -> None:
    named = [(name, getattr(ultragray_client, name)) for name in ultragray_client.__all__]
    built = (ultragray_client.FrameStream, ultragray_client.AsyncFrameStream)  # by `stream`
    found = {
        call_of(value) if isinstance(value, type) and not issubclass(value, (Enum, *built)) else name
        for name, value in named
    }
    assert set(table("Python client")) == found


def test_client_methods() -> None:
    groups = {
        "": ultragray_client.Client,
        "scenes.": client_scenes.Scenes,
        "datasets.": client_datasets.Datasets,
        "jobs.": client_jobs.Jobs,
        "stream.": ultragray_client.FrameStream,
    }
    found = [
        prefix + call_of(method).replace("(self, ", "(").replace("(self)", "()")
        for prefix, cls in groups.items()
        for name, method in vars(cls).items()
        if not name.startswith("_")
    ]
    assert list(table("Client methods")) == found


def test_client_errors() -> None:
    documented = [tuple(code(cell)[0] for cell in row) for row in rows("Client errors")]
    found = [(cls.reason, cls.__name__, cls.__mro__[1].__name__) for cls in ultragray_client.errors.ERRORS]
    assert documented == found


# Errors, settings, command line


def all_errors() -> list[type[errors.UltragrayError]]:
    return [
        value for value in vars(errors).values() if isinstance(value, type) and issubclass(value, errors.UltragrayError)
    ]


def test_errors() -> None:
    documented = [
        (code(reason)[0], code(cls)[0], cls.startswith("↳"), int(http), grpc)
        for reason, cls, http, grpc, _ in rows("Errors")
    ]
    assert documented == [
        (
            cls.reason,
            cls.__name__,
            issubclass(cls, errors.InvalidArgument) and cls is not errors.InvalidArgument,
            cls.http_status,
            cls.grpc_status,
        )
        for cls in all_errors()
    ]


def limits_of(field: FieldInfo) -> list[Any]:
    """The words that may be chosen, or the least and the greatest number."""
    bounds = [getattr(bound, name) for bound in field.metadata for name in ("ge", "gt", "le") if hasattr(bound, name)]
    return bounds or list(typing.get_args(field.annotation) if isinstance(field.default, str) else ())


def test_settings() -> None:
    documented = {
        name: (code(default), code(limits) or numbers(limits))
        for name, (default, limits, _) in table("Settings").items()
    }
    assert documented == {
        ENVIRONMENT_PREFIX + name.upper(): ([str(field.default)] if field.default != () else [], limits_of(field))
        for name, field in Settings.model_fields.items()
    }


def test_command_line() -> None:
    commands = typer.main.get_command(command_line).commands  # type: ignore[attr-defined]
    assert list(table("Command line")) == list(commands)
    while groups := [name for name in commands if hasattr(commands[name], "commands")]:
        name = groups[0]
        group = commands.pop(name)
        commands |= {f"{name} {command}": value for command, value in group.commands.items()}
    for name, command in commands.items():
        documented = [code(first) for first, _ in rows(f"ultragray {name}")]
        assert documented == [
            [parameter.name.upper()] if parameter.param_type_name == "argument" else list(parameter.opts)
            for parameter in command.params
        ], name


def test_training_settings() -> None:
    presets = [TrainingConfig.preset(name).to_dict() for name in ("fast", "paper")]
    documented = {
        name: [json.loads(code(cell)[0]) for cell in cells[:2]] for name, cells in table("Training settings").items()
    }
    assert documented == {name: [preset[name] for preset in presets] for name in presets[0]}


def test_exit_codes() -> None:
    assert set(table("Exit codes")) == {"0", "1", *map(str, (USER_ERROR, JOB_FAILED, JOB_CANCELLED, INTERRUPTED))}


# Metrics, logs, limits


def test_metrics(service: Service) -> None:
    service.metrics.count_request("http", "/", "200", 0.1)
    service.metrics.count_frame_error("QUEUE_FULL")
    service.jobs.counts = {JobState.QUEUED: 1}
    found = {}
    for metric in service.metrics.registry.collect():
        if not metric.name.startswith("process_"):
            suffix = "_total" if metric.type == "counter" else ""
            labels = {label for sample in metric.samples for label in sample.labels} - {"le"}
            found[metric.name + suffix] = (metric.type, labels)
    assert {name: (kind, set(code(labels))) for name, (kind, labels, _) in table("Metrics").items()} == found


def test_logs() -> None:
    token = request_id.set("one")
    try:
        raise ValueError("no")
    except ValueError:
        record = logging.LogRecord("ultragray", logging.INFO, "", 0, "text", (), sys.exc_info())
        assert list(table("Logs")) == list(json.loads(JsonFormatter().format(record)))
    finally:
        request_id.reset(token)


def test_fixed_limits() -> None:
    documented = {cells[0]: code(cells[1])[0] for cells in rows("Fixed limits")}
    assert documented.pop("Scene names") == scenes._NAME.pattern
    assert documented.pop("Dataset names") == dataset_store._NAME.pattern
    assert {name: float(value) for name, value in documented.items()} == {
        "Rotation tolerance": pose.ROTATION_TOLERANCE,
        "Largest coordinate of a pose": pose.MAX_POSITION_MM,
        "Largest length of a probe": probe.MAX_LENGTH_MM,
        "Largest opening angle": 175,
        "Largest height and width of the library": request.MAX_IMAGE_SIDE,
        "Height and width where the scene knows none": scene_info.DEFAULT_IMAGE_SIDE,
        "Largest spherical-harmonic degree": scene_info.MAX_SH_DEGREE,
        "Scenes on one page, default": catalog.DEFAULT_PAGE_SIZE,
        "Scenes on one page": catalog.MAX_PAGE_SIZE,
        "Datasets on one page, default": catalog.DEFAULT_PAGE_SIZE,
        "Datasets on one page": catalog.MAX_PAGE_SIZE,
        "Uploads at the same time": dataset_uploads.MAX_UPLOADS,
        "Files of a dataset": dataset_unpack.MAX_FILES,
        "Check of a dataset": dataset_uploads.CHECK_TIMEOUT_S,
        "Frames in flight in one ordered stream": pose_stream.MAX_FRAMES_IN_FLIGHT,
        "Bytes of these frames, if there are several": pose_stream.MAX_BYTES_IN_FLIGHT,
        "Message to a WebSocket": server.MAX_STREAM_MESSAGE_BYTES,
        "gRPC message received": grpc_server.MAX_RECEIVE_BYTES,
        "Keepalive pings of a gRPC client, no more often than every": grpc_server.LEAST_PING_INTERVAL_MS,
        "JPEG quality": pixels.JPEG_QUALITY,
        "Retry after": errors.QueueFull.retry_after_s,
        "Shortest API key": 16,
    }
    assert errors.NotReady.retry_after_s == errors.Draining.retry_after_s == errors.QueueFull.retry_after_s
    ConvexProbe(175, 1, 2)
    with pytest.raises(errors.InvalidProbe):
        ConvexProbe(math.nextafter(175, 180), 1, 2)
    load_settings(api_keys="k" * 16)
    with pytest.raises(errors.InvalidArgument):
        load_settings(api_keys="k" * 15)

"""Who may do what: the one table of all operations, with the role that each needs, for every door.

A route or method without a row stops the service at its start.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from starlette.routing import compile_path

from ultragray_service.access.principals import Role
from ultragray_workers.jobs.owners import Kind

STREAM = "stream"  # the operation of poses in, frames out
WATCH = "stream.watch"  # of somebody's stream
WEBSOCKET = "WEBSOCKET"  # in place of the method, of a route that is one


@dataclass(frozen=True)
class Operation:
    """Something that a client may ask for.

    `role` None: anybody may, also without a key. `about`: what kind of thing it names. `owned`: it must be the
    caller's own, but for admins. `changes`: it leaves something behind, and stands in the audit log one by one.
    """

    name: str
    role: Role | None
    http: tuple[str, ...] = ()
    grpc: tuple[str, ...] = ()  # of ultragray.v1
    about: Kind | None = None
    owned: bool = False

    @property
    def lasts(self) -> bool:
        """Whether its begin and its end stand in the audit log."""
        return self.name in (STREAM, WATCH)

    @property
    def changes(self) -> bool:
        return self.role in (Role.OPERATOR, Role.ADMIN)


_READER, _OPERATOR, _ADMIN = Role.READER, Role.OPERATOR, Role.ADMIN


def _operation(name: str, role: Role | None, *doors: str, about: Kind | None = None, owned: bool = False) -> Operation:
    """An operation by its doors: routes of HTTP, "METHOD /path", and methods of gRPC, "Service/Method".

    `about`: of one without a route, which would name it.
    """
    http = tuple(door for door in doors if " " in door)
    for kind in Kind:
        about = kind if any(f"{{{kind.value}}}" in route for route in http) else about
    return Operation(name, role, http, tuple(door for door in doors if " " not in door), about, owned)


OPERATIONS = (
    # Frames come first: their route is the one that must be found fast.
    _operation("render", _READER, "POST /v1/scenes/{scene}/render", "RenderService/Render"),
    _operation("slice", _READER, "POST /v1/scenes/{scene}:slice", "RenderService/RenderSlice"),
    _operation("render.batch", _READER, "RenderService/RenderBatch", about=Kind.SCENE),
    _operation("scene.localize", _READER, "POST /v1/scenes/{scene}:localize", "RenderService/Localize"),
    _operation("scene.plan", _READER, "POST /v1/scenes/{scene}:plan", "RenderService/PlanViews"),
    _operation(STREAM, _READER, f"{WEBSOCKET} /v1/scenes/{{scene}}/stream", "RenderService/RenderStream"),
    _operation("stream.list", _READER, "GET /v1/streams"),
    _operation("stream.correct", _READER, "POST /v1/streams/{stream}/real-frames"),
    _operation(WATCH, _READER, f"{WEBSOCKET} /v1/streams/{{stream}}/watch"),
    _operation("probe.plane", _READER, "POST /v1/probes:plane"),
    _operation("scene.list", _READER, "GET /v1/scenes", "SceneService/ListScenes"),
    _operation(
        "scene.get",
        _READER,
        "GET /v1/scenes/{scene}",
        "GET /v1/scenes/{scene}/gaussians",
        "GET /v1/scenes/{scene}/training-poses",
        "GET /v1/scenes/{scene}/thumbnail.png",
        "POST /v1/scenes/{scene}:assess",
        "GET /v1/scenes/{scene}/comparison",
        "GET /v1/scenes/{scene}/comparison/{index}/{what}.png",
        "SceneService/GetScene",
        "RenderService/AssessPoses",
    ),
    _operation("scene.download", _READER, "GET /v1/scenes/{scene}/file", "GET /v1/scenes/{scene}/file.ugz"),
    _operation("scene.load", _OPERATOR, "POST /v1/scenes/{scene}:load", "SceneService/LoadScene"),
    _operation("scene.unload", _OPERATOR, "POST /v1/scenes/{scene}:unload", "SceneService/UnloadScene"),
    _operation(
        "scene.label",
        _OPERATOR,
        "POST /v1/scenes/{scene}:label",
        "POST /v1/scenes/{scene}:label-by-map",
        "SceneService/LabelScene",
    ),
    _operation("scene.edit", _OPERATOR, "POST /v1/scenes/{scene}:edit", "SceneService/EditScene"),
    _operation("scene.make", _OPERATOR, "POST /v1/scenes:from-labels", "SceneService/MakeScene"),
    _operation("scene.import", _OPERATOR, "PUT /v1/scenes/{scene}"),
    _operation("scene.delete", _OPERATOR, "DELETE /v1/scenes/{scene}", owned=True),
    _operation("registration.list", _READER, "GET /v1/registrations", "RegistrationService/ListRegistrations"),
    _operation(
        "registration.get", _READER, "GET /v1/registrations/{registration}", "RegistrationService/GetRegistration"
    ),
    _operation(
        "registration.put", _OPERATOR, "PUT /v1/registrations/{registration}", "RegistrationService/PutRegistration"
    ),
    _operation(
        "registration.delete",
        _OPERATOR,
        "DELETE /v1/registrations/{registration}",
        "RegistrationService/DeleteRegistration",
        owned=True,
    ),
    _operation("dataset.list", _READER, "GET /v1/datasets", "DatasetService/ListDatasets"),
    _operation(
        "dataset.get",
        _READER,
        "GET /v1/datasets/{dataset}",
        "GET /v1/datasets/{dataset}/contact-sheet",
        "GET /v1/datasets/{dataset}/poses",
        "GET /v1/datasets/{dataset}/frames/{part}/{index}",
        "DatasetService/GetDataset",
        "DatasetService/GetContactSheet",
    ),
    _operation(
        "dataset.upload",
        _OPERATOR,
        "PUT /v1/datasets/{dataset}",
        "POST /v1/datasets/{dataset}:simulate",
        "DatasetService/UploadDataset",
    ),
    _operation("recording.begin", _OPERATOR, "PUT /v1/recordings/{dataset}", "RecordingService/BeginRecording"),
    _operation("recording.get", _READER, "GET /v1/recordings/{dataset}", "RecordingService/GetRecording"),
    _operation(
        "recording.add",
        _OPERATOR,
        "POST /v1/recordings/{dataset}/frames",
        f"{WEBSOCKET} /v1/recordings/{{dataset}}/stream",
        "RecordingService/RecordFrames",  # its first message names the recording: the owner is looked up then
    ),
    _operation(
        "recording.finish",
        _OPERATOR,
        "POST /v1/recordings/{dataset}:finish",
        "RecordingService/FinishRecording",
        owned=True,
    ),
    _operation(
        "recording.delete",
        _OPERATOR,
        "DELETE /v1/recordings/{dataset}",
        "RecordingService/DeleteRecording",
        owned=True,
    ),
    _operation(
        "dataset.delete", _OPERATOR, "DELETE /v1/datasets/{dataset}", "DatasetService/DeleteDataset", owned=True
    ),
    _operation("job.list", _READER, "GET /v1/jobs", "JobService/ListJobs"),
    _operation(
        "job.get",
        _READER,
        "GET /v1/jobs/{job}",
        "GET /v1/jobs/{job}/log",
        "GET /v1/jobs/{job}/curve",
        "GET /v1/jobs/{job}/preview",
        "GET /v1/jobs/{job}/events",
        "JobService/GetJob",
        "JobService/GetJobLog",
        "JobService/WatchJob",
    ),
    _operation("job.download", _READER, "GET /v1/jobs/{job}/artifacts/{name}", "JobService/DownloadArtifact"),
    _operation("job.estimate", _READER, "POST /v1/jobs:estimate", "JobService/EstimateJob"),
    _operation("job.submit", _OPERATOR, "POST /v1/jobs", "JobService/SubmitJob"),
    _operation("job.cancel", _OPERATOR, "POST /v1/jobs/{job}:cancel", "JobService/CancelJob", owned=True),
    _operation("job.retry", _OPERATOR, "POST /v1/jobs/{job}:retry", "JobService/RetryJob", owned=True),
    _operation("job.delete", _OPERATOR, "DELETE /v1/jobs/{job}", "JobService/DeleteJob", owned=True),
    _operation("worker.list", _READER, "GET /v1/workers", "WorkerService/ListWorkers"),
    _operation("worker.pause", _ADMIN, "POST /v1/workers/{worker}:pause", "WorkerService/PauseWorker"),
    _operation("worker.drain", _ADMIN, "POST /v1/workers/{worker}:drain", "WorkerService/DrainWorker"),
    _operation("worker.resume", _ADMIN, "POST /v1/workers/{worker}:resume", "WorkerService/ResumeWorker"),
    _operation("service.watch", _READER, "GET /v1/statistics", "GET /metrics"),
    _operation("service.get", _READER, "GET /v1/service"),
    _operation("me", _READER, "GET /v1/me", "AccessService/WhoAmI"),
    _operation("audit.list", _ADMIN, "GET /v1/audit", "AccessService/ListAuditEntries"),
    _operation(
        "public",
        None,
        "GET /v1/health/live",
        "GET /v1/health/ready",
        "GET /v1/sign-in",
        "GET /docs",
        "GET /docs/static/{path:path}",
        "GET /openapi.json",
        "GET /",
        "GET /favicon.svg",
        "GET /licences.txt",
        "GET /assets/{path:path}",
        "GET /package/{path:path}",
    ),
)


class HttpRules:
    def __init__(self, operations: Iterable[Operation] = OPERATIONS) -> None:
        self._routes: dict[str, list[tuple[str, Operation]]] = {}
        for operation in operations:
            for route in operation.http:
                method, _, path = route.partition(" ")
                self._routes.setdefault(method, []).append((path, operation))
        self._compiled = {
            method: [(compile_path(path)[0], operation) for path, operation in entries]
            for method, entries in self._routes.items()
        }

    def find(self, method: str, path: str) -> tuple[Operation, str] | None:
        """The operation, by the first route that matches, and the name of what it is about; None: no route is known."""
        for pattern, operation in self._compiled.get("GET" if method == "HEAD" else method, ()):
            if (match := pattern.match(path)) is not None:
                return operation, "" if operation.about is None else match[operation.about.value]
        return None

    def require_all(self, routes: Iterable[tuple[str, str]]) -> None:
        known = {(method, path) for method, entries in self._routes.items() for path, _ in entries}
        missing = sorted({(method, path) for method, path in routes if method not in ("HEAD", "OPTIONS")} - known)
        if missing:
            raise LookupError(f"access/rules.py does not say who may ask for {missing}")

    def routes(self) -> Iterator[tuple[str, str, Operation]]:
        for method, entries in self._routes.items():
            for path, operation in entries:
                yield method, path, operation


PACKAGE = "ultragray.v1"
GRPC_OPERATIONS = {f"/{PACKAGE}.{method}": operation for operation in OPERATIONS for method in operation.grpc}


UNKNOWN = Operation("unknown", None)  # a route that is not there
REFLECTION = Operation("reflection", _READER)
IGTL = Operation(STREAM, _READER)


def require_all_methods(methods: Iterable[str]) -> None:
    if missing := sorted(set(methods) - GRPC_OPERATIONS.keys()):
        raise LookupError(f"access/rules.py does not say who may call {missing}")

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
    http: tuple[str, ...] = ()  # "METHOD /path"
    grpc: tuple[str, ...] = ()  # "Service/Method" of ultragray.v1
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
_SCENE, _DATASET, _JOB, _WORKER = Kind.SCENE, Kind.DATASET, Kind.JOB, Kind.WORKER
_REGISTRATION = Kind.REGISTRATION

OPERATIONS = (
    # Frames come first: their route is the one that must be found fast.
    Operation("render", _READER, ("POST /v1/scenes/{scene}/render",), ("RenderService/Render",), _SCENE),
    Operation("slice", _READER, ("POST /v1/scenes/{scene}:slice",), ("RenderService/RenderSlice",), _SCENE),
    Operation("render.batch", _READER, (), ("RenderService/RenderBatch",), _SCENE),
    Operation("scene.localize", _READER, ("POST /v1/scenes/{scene}:localize",), ("RenderService/Localize",), _SCENE),
    Operation(STREAM, _READER, (f"{WEBSOCKET} /v1/scenes/{{scene}}/stream",), ("RenderService/RenderStream",), _SCENE),
    Operation("stream.list", _READER, ("GET /v1/streams",)),
    Operation(WATCH, _READER, (f"{WEBSOCKET} /v1/streams/{{stream}}/watch",)),
    Operation("probe.plane", _READER, ("POST /v1/probes:plane",)),
    Operation("scene.list", _READER, ("GET /v1/scenes",), ("SceneService/ListScenes",)),
    Operation(
        "scene.get",
        _READER,
        (
            "GET /v1/scenes/{scene}",
            "GET /v1/scenes/{scene}/gaussians",
            "GET /v1/scenes/{scene}/training-poses",
            "POST /v1/scenes/{scene}:assess",
            "GET /v1/scenes/{scene}/comparison",
            "GET /v1/scenes/{scene}/comparison/{index}/{what}.png",
        ),
        ("SceneService/GetScene", "RenderService/AssessPoses"),
        _SCENE,
    ),
    Operation("scene.download", _READER, ("GET /v1/scenes/{scene}/file",), (), _SCENE),
    Operation("scene.load", _OPERATOR, ("POST /v1/scenes/{scene}:load",), ("SceneService/LoadScene",), _SCENE),
    Operation("scene.unload", _OPERATOR, ("POST /v1/scenes/{scene}:unload",), ("SceneService/UnloadScene",), _SCENE),
    Operation("scene.import", _OPERATOR, ("PUT /v1/scenes/{scene}",), (), _SCENE),
    Operation("scene.delete", _OPERATOR, ("DELETE /v1/scenes/{scene}",), (), _SCENE, owned=True),
    Operation("registration.list", _READER, ("GET /v1/registrations",), ("RegistrationService/ListRegistrations",)),
    Operation(
        "registration.get",
        _READER,
        ("GET /v1/registrations/{registration}",),
        ("RegistrationService/GetRegistration",),
        _REGISTRATION,
    ),
    Operation(
        "registration.put",
        _OPERATOR,
        ("PUT /v1/registrations/{registration}",),
        ("RegistrationService/PutRegistration",),
        _REGISTRATION,
    ),
    Operation(
        "registration.delete",
        _OPERATOR,
        ("DELETE /v1/registrations/{registration}",),
        ("RegistrationService/DeleteRegistration",),
        _REGISTRATION,
        owned=True,
    ),
    Operation("dataset.list", _READER, ("GET /v1/datasets",), ("DatasetService/ListDatasets",)),
    Operation(
        "dataset.get",
        _READER,
        (
            "GET /v1/datasets/{dataset}",
            "GET /v1/datasets/{dataset}/contact-sheet",
            "GET /v1/datasets/{dataset}/poses",
            "GET /v1/datasets/{dataset}/frames/{part}/{index}",
        ),
        ("DatasetService/GetDataset", "DatasetService/GetContactSheet"),
        _DATASET,
    ),
    Operation(
        "dataset.upload", _OPERATOR, ("PUT /v1/datasets/{dataset}",), ("DatasetService/UploadDataset",), _DATASET
    ),
    Operation(
        "dataset.delete",
        _OPERATOR,
        ("DELETE /v1/datasets/{dataset}",),
        ("DatasetService/DeleteDataset",),
        _DATASET,
        owned=True,
    ),
    Operation("job.list", _READER, ("GET /v1/jobs",), ("JobService/ListJobs",)),
    Operation(
        "job.get",
        _READER,
        (
            "GET /v1/jobs/{job}",
            "GET /v1/jobs/{job}/log",
            "GET /v1/jobs/{job}/curve",
            "GET /v1/jobs/{job}/preview",
            "GET /v1/jobs/{job}/events",
        ),
        ("JobService/GetJob", "JobService/GetJobLog", "JobService/WatchJob"),
        _JOB,
    ),
    Operation(
        "job.download", _READER, ("GET /v1/jobs/{job}/artifacts/{name}",), ("JobService/DownloadArtifact",), _JOB
    ),
    Operation("job.estimate", _READER, ("POST /v1/jobs:estimate",), ("JobService/EstimateJob",)),
    Operation("job.submit", _OPERATOR, ("POST /v1/jobs",), ("JobService/SubmitJob",)),
    Operation("job.cancel", _OPERATOR, ("POST /v1/jobs/{job}:cancel",), ("JobService/CancelJob",), _JOB, owned=True),
    Operation("job.retry", _OPERATOR, ("POST /v1/jobs/{job}:retry",), ("JobService/RetryJob",), _JOB, owned=True),
    Operation("job.delete", _OPERATOR, ("DELETE /v1/jobs/{job}",), ("JobService/DeleteJob",), _JOB, owned=True),
    Operation("worker.list", _READER, ("GET /v1/workers",), ("WorkerService/ListWorkers",)),
    Operation("worker.pause", _ADMIN, ("POST /v1/workers/{worker}:pause",), ("WorkerService/PauseWorker",), _WORKER),
    Operation("worker.drain", _ADMIN, ("POST /v1/workers/{worker}:drain",), ("WorkerService/DrainWorker",), _WORKER),
    Operation("worker.resume", _ADMIN, ("POST /v1/workers/{worker}:resume",), ("WorkerService/ResumeWorker",), _WORKER),
    Operation("service.watch", _READER, ("GET /v1/statistics", "GET /metrics")),
    Operation("service.get", _READER, ("GET /v1/service",)),
    Operation("me", _READER, ("GET /v1/me",), ("AccessService/WhoAmI",)),
    Operation("audit.list", _ADMIN, ("GET /v1/audit",), ("AccessService/ListAuditEntries",)),
    Operation(
        "public",
        None,
        (
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
        ),
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
            method: [(compile_path(path)[0], operation) for path, operation in found]
            for method, found in self._routes.items()
        }

    def find(self, method: str, path: str) -> tuple[Operation, str] | None:
        """The operation, and the name of what it is about; None where no route is known.

        A path goes to the first route that it matches, as in the application.
        """
        for pattern, operation in self._compiled.get("GET" if method == "HEAD" else method, ()):
            if (match := pattern.match(path)) is not None:
                return operation, "" if operation.about is None else match[operation.about.value]
        return None

    def require_all(self, routes: Iterable[tuple[str, str]]) -> None:
        known = {(method, path) for method, found in self._routes.items() for path, _ in found}
        missing = sorted({(method, path) for method, path in routes if method not in ("HEAD", "OPTIONS")} - known)
        if missing:
            raise LookupError(f"access/rules.py does not say who may ask for {missing}")

    def routes(self) -> Iterator[tuple[str, str, Operation]]:
        for method, found in self._routes.items():
            for path, operation in found:
                yield method, path, operation


PACKAGE = "ultragray.v1"
GRPC_OPERATIONS = {f"/{PACKAGE}.{method}": operation for operation in OPERATIONS for method in operation.grpc}


UNKNOWN = Operation("unknown", None)  # a route that is not there
REFLECTION = Operation("reflection", _READER)
IGTL = Operation(STREAM, _READER)


def require_all_methods(methods: Iterable[str]) -> None:
    if missing := sorted(set(methods) - GRPC_OPERATIONS.keys()):
        raise LookupError(f"access/rules.py does not say who may call {missing}")

"""Jobs over HTTP against a real service without a worker: they stay queued; progress is told as a worker would."""

import json
import threading
from dataclasses import MISSING, dataclass, fields

import httpx
import pytest
import sqlalchemy as sa
from pydantic import TypeAdapter

from ultragray_service.core.jobs import TAIL_BYTES
from ultragray_service.http.bodies import SPECIFICATIONS
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.kinds import Specification
from ultragray_workers.jobs.progress import Files, Piece
from ultragray_workers.jobs.tables import JOBS
from ultragray_workers.storage.local import LocalStorage

from ...waiting import wait_until

RENDER = {"kind": "render", "specification": {"scene": "demo", "sampler": {"kind": "training"}}}
WAIT_S = 300.0


@pytest.fixture(scope="module")
def service(start_service, artifacts):
    """A service without a worker: what is submitted waits."""
    return start_service(artifact_folder=artifacts)


def submit(http, **changes):
    answer = http.post("/v1/jobs", json=RENDER | changes)
    assert answer.status_code == 201, answer.text
    return answer.json()


def problem(answer):
    document = answer.json()
    assert answer.headers["content-type"] == "application/problem+json"
    return answer.status_code, document["reason"], document["field"]


def test_the_life_of_a_job_that_no_worker_takes(http):
    body = RENDER | {"request_id": "mine/1", "priority": 3}
    first, again = http.post("/v1/jobs", json=body), http.post("/v1/jobs", json=body)
    assert (first.status_code, again.status_code, again.json()) == (201, 200, first.json())
    job = first.json()
    route = f"/v1/jobs/{job['id']}"
    assert (job["state"], job["kind"], job["priority"], job["attempts"]) == ("queued", "render", 3, 0)
    assert job["specification"]["scene"] == "demo"
    assert job["started_at"] is job["finished_at"] is job["reason"] is None
    told = {name: value for name, value in job["progress"].items() if value is not None}
    assert told == {"waits_for": "a worker: none is running"}
    assert http.get(route).json() == job
    assert problem(http.post("/v1/jobs", json=body | {"priority": 1})) == (409, "REQUEST_ID_CONFLICT", "request_id")
    log = http.get(f"{route}/log")
    assert (log.status_code, log.text, log.headers["content-type"][:10]) == (200, "", "text/plain")
    for name, reason in (("..%2fjob.json", "ROUTE_NOT_FOUND"), ("metrics.json", "ARTIFACT_NOT_FOUND")):
        assert problem(http.get(f"{route}/artifacts/{name}"))[:2] == (404, reason)
    assert problem(http.post(f"{route}:retry")) == (409, "JOB_NOT_FINISHED", "job")
    assert problem(http.delete(route)) == (409, "JOB_IN_USE", "job")
    for _ in range(2):
        cancelled = http.post(f"{route}:cancel")
        assert (cancelled.status_code, cancelled.json()["state"]) == (200, "cancelled")
    retried = [http.post(f"{route}:retry") for _ in range(2)]
    assert [(one.status_code, one.json()["retry_of"]) for one in retried] == [(201, job["id"]), (200, job["id"])]
    successor = f"/v1/jobs/{retried[0].json()['id']}"
    for gone in (successor, route):
        http.post(f"{gone}:cancel")
        assert http.delete(gone).status_code == 204
        for answer in (http.get(gone), http.delete(gone)):
            assert problem(answer) == (404, "JOB_NOT_FOUND", "job")


def test_pages_join_to_the_whole_list(http):
    made = [submit(http)["id"] for _ in range(3)]
    found, token = [], ""
    while token or not found:
        page = http.get("/v1/jobs", params={"page_size": 2, "page_token": token, "state": "queued"}).json()
        found += [job["id"] for job in page["jobs"]]
        token = page["next_page_token"]
    assert (found[:3], len(set(found))) == (made[::-1], len(found))
    assert http.get("/v1/jobs", params={"kind": "train"}).json() == {"jobs": [], "next_page_token": ""}
    for name, value in (("page_token", "made-up"), ("state", "asleep")):
        assert problem(http.get("/v1/jobs", params={name: value}))[1:] == ("INVALID_ARGUMENT", name)


def test_a_render_job_is_estimated_and_not_submitted(http):
    before = http.get("/v1/jobs").json()["jobs"]
    sampler = {"kind": "around", "count": 300}
    asked = {"scene": "demo", "sampler": sampler, "height": 32, "width": 16, "outputs": ["bmode", "echo"]}
    found = http.post("/v1/jobs:estimate", json={"kind": "render", "specification": asked | {"dtype": "float32"}})
    assert found.status_code == 200, found.text
    told = found.json()
    assert (told["frames"], told["files"], told["height"], told["width"]) == (300, 1, 32, 16)
    assert told["bytes"] == 300 * 32 * 16 * (4 + 4)
    assert len(told["poses"]) == 256
    assert told["seconds"] > 0.0
    assert http.get("/v1/jobs").json()["jobs"] == before


@pytest.mark.parametrize(
    ("kind", "specification", "expected"),
    [
        ("train", {"dataset": "a", "scene": "b"}, (422, "INVALID_ARGUMENT", "kind")),
        ("render", {"scene": "none", "sampler": {"kind": "training"}}, (404, "SCENE_NOT_FOUND", "specification.scene")),
        (
            "render",
            {"scene": "demo", "sampler": {"kind": "fan", "tilt_deg": 90, "step_deg": 1e-3}},
            (422, "INVALID_ARGUMENT", "specification.step_deg"),
        ),
    ],
)
def test_what_cannot_be_estimated(http, kind, specification, expected):
    assert problem(http.post("/v1/jobs:estimate", json={"kind": kind, "specification": specification})) == expected


@pytest.mark.parametrize(
    ("body", "status", "reason", "field"),
    [
        ({"specification": {"scene": "demo"}}, 422, "INVALID_ARGUMENT", "kind"),
        (RENDER | {"urgent": True}, 422, "INVALID_ARGUMENT", "urgent"),
        (RENDER | {"priority": 1001}, 422, "INVALID_ARGUMENT", "priority"),
        ({"kind": "render", "specification": {"scene": "demo"}}, 422, "INVALID_ARGUMENT", "specification.poses"),
        ({"kind": "render", "specification": {"kind": "train"}}, 422, "INVALID_ARGUMENT", "specification.kind"),
        (
            {"kind": "render", "specification": {"scene": "demo", "poses": [[[1, 2], [3, 4]]]}},
            422,
            "INVALID_POSE",
            "specification.poses",
        ),
        (
            {"kind": "train", "specification": {"dataset": "gone", "scene": "new"}},
            404,
            "DATASET_NOT_FOUND",
            "specification.dataset",
        ),
        (
            {"kind": "train", "specification": {"dataset": "gone", "scene": "new", "settings": {"stepz": 3}}},
            422,
            "INVALID_ARGUMENT",
            "specification.settings.stepz",
        ),
    ],
)
def test_what_cannot_be_run_is_refused_by_name(http, body, status, reason, field):
    assert problem(http.post("/v1/jobs", json=body)) == (status, reason, field)


def test_jobs_are_counted_for_prometheus(http, service):
    before = len(http.get("/v1/jobs", params={"state": "queued", "page_size": 1000}).json()["jobs"])
    submit(http)
    wait_until(lambda: service.metric('ultragray_jobs{state="queued"}') == before + 1)
    assert service.metric('ultragray_jobs{state="failed"}') == 0


def test_each_kind_has_a_documented_specification():
    for model, (kind, taken) in zip(SPECIFICATIONS, Specification.members.items(), strict=True):
        assert model.__name__ == f"{kind.title()}Specification"
        schema = TypeAdapter(model).json_schema()
        assert set(schema["properties"]) == {field.name for field in fields(taken)} - {"kind"}
        assert set(schema["required"]) == {
            field.name for field in fields(taken) if field.default is MISSING and field.default_factory is MISSING
        }


def test_a_full_queue_refuses_and_a_stopping_service_ends_the_events_at_once(start_service, tmp_path):
    service = start_service(artifact_folder=tmp_path, job_queue_limit=1)
    with httpx.Client(base_url=service.http, timeout=WAIT_S) as http:
        job = submit(http, request_id="kept")
        full = http.post("/v1/jobs", json=RENDER)
        assert problem(full) == (429, "JOB_QUEUE_FULL", None)
        assert full.headers["retry-after"] == "10"
        with http.stream("GET", f"/v1/jobs/{job['id']}/events") as answer:
            told = read_events(answer.iter_lines())
            assert json.loads(next(told).data)["state"] == "queued"
            service.process.terminate()
            assert list(told) == []
            assert service.process.wait(WAIT_S) == 0


@dataclass(frozen=True)
class Event:
    name: str
    id: str
    data: str


def read_events(lines):
    fields = {}
    for line in lines:
        name, _, value = line.partition(": ")
        if line:
            fields.setdefault(name, []).append(value)
            continue
        if "event" in fields:
            yield Event(fields["event"][0], fields["id"][0], "\n".join(fields["data"]))
        fields = {}


class ToldLog:
    """The log of a job, as a worker tells it."""

    def __init__(self, folder, job):
        self._folder, self._job = folder, job
        self._storage, self._pieces = LocalStorage(folder), list[Piece]()
        self.text = ""

    def write(self, text):
        piece = Piece(f"jobs/{self._job}/1-1/log-{len(self._pieces):05d}", len(text.encode()))
        self._storage.write(piece.key, text.encode())
        self._pieces.append(piece)
        jobs = JobDatabase(self._folder, None)
        with jobs.engine.begin() as connection:
            files = Files(log=tuple(self._pieces))
            connection.execute(sa.update(JOBS).where(JOBS.c.id == self._job).values(files=files))
        jobs.close()
        self.text += text


@pytest.fixture
def job(http):
    return str(submit(http)["id"])


@pytest.fixture
def log(artifacts, job):
    return ToldLog(artifacts, job)


def follow(http, job, last, wanted=None):
    """The events after `last`, until the job ends, or until `wanted` came and the connection is cut."""
    headers = {"Last-Event-ID": last} if last else {}
    told = []
    with http.stream("GET", f"/v1/jobs/{job}/events", headers=headers) as answer:
        assert answer.status_code == 200
        for event in read_events(answer.iter_lines()):
            told.append(event)
            if len(told) == wanted:
                break
    return told


def log_of(events):
    return "".join(f"{event.data}\n" for event in events if event.name == "log")


def test_a_client_that_comes_back_again_and_again_has_every_line_once(http, job, log):

    def write():
        for begin in range(0, 40_000, 2000):
            log.write("".join(f"step {begin + number:06d}: ähnlich wie vorher\n" for number in range(2000)))
            stop.wait(0.1)

    stop = threading.Event()
    told = follow(http, job, "", wanted=1)
    assert [event.name for event in told] == ["progress"]
    writing = threading.Thread(target=write)
    writing.start()
    try:
        while log_of(told).count("\n") < 40_000:
            told += follow(http, job, told[-1].id, wanted=1)
    finally:
        stop.set()
        writing.join(WAIT_S)
    http.post(f"/v1/jobs/{job}:cancel")
    told += follow(http, job, told[-1].id)
    assert log_of(told) == log.text
    states = [json.loads(event.data)["state"] for event in told if event.name == "progress"]
    assert states == ["queued", "cancelled"]
    assert follow(http, job, told[-1].id) == []


def test_who_names_no_event_or_an_unknown_one_begins_with_the_job_and_the_last_lines(http, job, log):
    log.write("".join(f"line {number}\n" for number in range(5000)))
    for last in ("", "7", "of another service", "9" * 40 + "-", "-1-"):
        told = follow(http, job, last, wanted=2)
        assert [event.name for event in told] == ["log", "progress"]
        lines = log_of(told)
        assert log.text.endswith(lines)
        assert TAIL_BYTES - 20 < len(lines) <= TAIL_BYTES


def test_lines_that_end_with_a_carriage_return_are_told_as_lines(http, job, log):
    log.write("one\r\ntwo\r\n\r\nthree 1 %\rthree 2 %\r\n")
    assert log_of(follow(http, job, "", wanted=1)) == "one\ntwo\n\nthree 1 %\nthree 2 %\n"

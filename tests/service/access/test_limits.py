"""Limits of keys: what they are, how they are counted, and that every door of a real service keeps them."""

import asyncio
import json
import time
from collections.abc import Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone

import grpc
import httpx
import numpy as np
import pytest
import sqlalchemy as sa
from google.rpc.error_details_pb2 import RetryInfo
from google.rpc.status_pb2 import Status
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from ultragray.errors import InvalidArgument
from ultragray_proto.v1 import access_pb2, access_pb2_grpc, rendering_pb2, rendering_pb2_grpc
from ultragray_service.access.keys import KeyStore
from ultragray_service.access.limits import WINDOW_S, Rate
from ultragray_service.access.principals import Allowance, Role, read_limits
from ultragray_service.settings import load_settings
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.tables import USAGE

from ...waiting import wait_until
from ..cli.command_line import run, succeeded
from ..conftest import RunningService, split
from ..igtl.conftest import Peer, address_of
from ..rpc.test_grpc_render import error_info, moved
from .conftest import MATRIX, POSE


def test_settings_limit_every_key(monkeypatch):
    monkeypatch.setenv("ULTRAGRAY_KEY_FRAMES_PER_S", "30")
    assert load_settings(key_stored_gb=0.5).allowance == Allowance(frames_per_s=30, stored_gb=0.5)


@pytest.mark.parametrize(
    "text", ["frames_per_s", "frames=3", "=3", "frames_per_s=0", "frames_per_s=often", "streams=-1"]
)
def test_a_limit_that_cannot_be_is_refused_with_what_was_given(text):
    with pytest.raises(InvalidArgument, match=r"frames_per_s|streams"):
        read_limits([text])


def test_a_key_keeps_limits_of_its_own(tmp_path):
    where = ("--artifact-folder", tmp_path)
    limits = ("--limit", "frames_per_s=30", "--limit", "stored_gb=1.5", "--limit", "streams=none")
    succeeded("keys", "create", "robot", "--role", "reader", *limits, *where)
    succeeded("keys", "create", "alice", "--role", "admin", *where)
    robot, alice = json.loads(run("keys", "list", "--json", *where).stdout)
    assert robot["limits"] == {"frames_per_s": 30, "stored_gb": 1.5, "streams": None}
    assert alice["limits"] == {}
    assert "frames_per_s=30 stored_gb=1.5 streams=none" in run("keys", "list", *where).stdout.replace("\n", " ")
    refused = run("keys", "create", "carol", "--role", "reader", "--limit", "frames=3", *where)
    assert refused.exit_code == 2
    assert "got 'frames=3'" in refused.stderr


def test_a_client_has_so_many_in_any_second_and_is_told_when_there_are_more(clock):
    rate = Rate()
    assert [rate.take("alice", 2), rate.take("alice", 2), rate.take("bob", 2)] == [0.0, 0.0, 0.0]
    wait_s = rate.take("alice", 2)
    assert 0.0 < wait_s <= 1.1 * WINDOW_S
    clock.now += wait_s
    assert rate.take("alice", 2) == 0.0


def test_several_at_once_are_taken_together_or_not_at_all(clock):
    rate = Rate()
    assert rate.take("alice", 4, 3) == 0.0
    wait_s = rate.take("alice", 4, 3)
    assert wait_s > 0.0
    assert rate.take("alice", 4, 1) == 0.0  # the refusal took none
    clock.now += max(wait_s, rate.take("alice", 4, 4))
    assert rate.take("alice", 4, 4) == 0.0


async def test_those_who_wait_are_served_in_the_order_in_which_they_came(clock):
    rate, served = Rate(), list[int]()

    async def client(number):
        assert await rate.wait("alice", 2, until=None) == 0.0
        served.append(number)

    began = clock.now
    await asyncio.gather(*(client(number) for number in range(5)))
    assert served == [0, 1, 2, 3, 4]
    assert clock.now - began >= 2 * WINDOW_S


async def test_nobody_waits_for_what_would_come_too_late(clock):
    rate = Rate()
    rate.take("alice", 1)
    began = clock.now
    assert await rate.wait("alice", 1, until=began + 0.001) > 0.0
    assert clock.now - began < WINDOW_S


def test_a_clock_that_is_set_back_keeps_nobody_out(monkeypatch):
    rate, now_s = Rate(), time.time()
    monkeypatch.setattr(time, "time", lambda: now_s + 3600.0)
    assert rate.take("alice", 1) == 0.0
    monkeypatch.undo()
    assert rate.take("alice", 1) == 0.0


LIMITS = {  # by the name of the key
    "requests": "requests_per_s=1",
    "calls": "requests_per_s=1",
    "frames": "frames_per_s=1",
    "poses": "frames_per_s=4",
    "batch": "frames_per_s=4",
    "gone": "frames_per_s=1",
    "ordered": "frames_per_s=4",
    "latest": "frames_per_s=2",
    "streams": "streams=1",
    "polite": "requests_per_s=none",
    "unlimited": "streams=none",
    "jobs": "unfinished_jobs=2",
    "minutes": "compute_minutes_per_day=1",
    "bytes": "stored_gb=0.000004",
    "unpacked": "stored_gb=0.000005",
    "full": "stored_gb=0",
    "registrations": "registrations=2",
}
SMALL = {"height": 16, "width": 16}


@dataclass(frozen=True)
class Limited:
    """The service, and a key for each limit."""

    service: RunningService
    keys: Mapping[str, str]
    client: httpx.Client
    channel: grpc.Channel
    database: JobDatabase

    def http(self, who, method, path, **options):
        return self.client.request(method, path, headers={"x-api-key": self.keys[who]}, **options)

    def render(self, who, **body):
        poses = {} if "poses" in body else {"pose": POSE}
        return self.http(who, "POST", "/v1/scenes/demo/render", json={**SMALL, **poses, **body})

    def metadata(self, who):
        return (("x-api-key", self.keys[who]),)

    def renders(self):
        return rendering_pb2_grpc.RenderServiceStub(self.channel)

    def refusals(self, limit, role="operator"):
        """How often a limit refused somebody, by the metrics."""
        headers = {"x-api-key": self.keys["unlimited"]}
        lines = self.client.get("/metrics", headers=headers).text.splitlines()
        name = f'ultragray_limited_total{{limit="{limit}",role="{role}"}}'
        return sum(float(line.rpartition(" ")[2]) for line in lines if line.startswith(name))


@pytest.fixture(scope="module")
def limited(start_service, artifacts):
    folder = artifacts
    database = JobDatabase(folder, None)
    store = KeyStore(database.engine)
    keys = {name: store.create(name, Role.OPERATOR, None, read_limits([limit]))[1] for name, limit in LIMITS.items()}
    service = start_service(artifact_folder=folder, key_streams=1)
    with httpx.Client(base_url=service.http, timeout=300) as client, service.channel() as channel:
        yield Limited(service, keys, client, channel, database)
    database.close()


def render_settings():
    return rendering_pb2.RenderSettings(scene="demo", **SMALL)


def retry_after_s(error, reason):
    """The delay of RetryInfo, where there is one, of a call that a limit refused."""
    assert error.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
    assert error_info(error)[0].reason == reason
    status = Status.FromString(dict(error.trailing_metadata())["grpc-status-details-bin"])
    delay = RetryInfo()
    found = [detail for detail in status.details if detail.Is(RetryInfo.DESCRIPTOR)]
    if not found:
        return None
    found[0].Unpack(delay)
    return float(delay.retry_delay.ToTimedelta().total_seconds())


def test_a_request_whose_client_has_gone_waits_for_no_more_of_its_frames(limited):
    body = {**SMALL, "poses": [POSE] * 250, "timeout_ms": 3_600_000}  # which take 250 s
    with pytest.raises(httpx.ReadTimeout):
        limited.http("gone", "POST", "/v1/scenes/demo/render", json=body, timeout=0.5)
    wait_until(lambda: any(record.get("status") == 499 for record in limited.service.log()), within_s=60)


DAY_S = 86_400


def submit(limited, who, **more):
    body = {"kind": "render", "specification": {"scene": "demo", "poses": [MATRIX]}, **more}
    return limited.http(who, "POST", "/v1/jobs", json=body)


def is_limit(answer, name):
    return (answer.status_code, answer.json()["reason"]) == (429, "LIMIT_REACHED") and name in answer.json()["detail"]


def ran(limited, device):
    """Half a minute on a device, of a job that has been deleted."""
    with limited.database.engine.begin() as connection:
        values = {"owner": "minutes", "device": device, "day": datetime.now(timezone.utc).date(), "run_s": 30.0}
        connection.execute(sa.insert(USAGE).values(values))


def test_only_so_many_jobs_of_a_key_wait_or_run(limited):
    first, second = (submit(limited, "jobs", request_id=name) for name in ("one", "two"))
    assert (first.status_code, second.status_code) == (201, 201)
    beyond = submit(limited, "jobs")
    assert is_limit(beyond, "unfinished_jobs")
    assert "Retry-After" not in beyond.headers
    assert submit(limited, "jobs", request_id="one").status_code == 200  # it is there already
    assert submit(limited, "unlimited").status_code == 201
    job = f"/v1/jobs/{first.json()['id']}"
    assert limited.http("jobs", "POST", f"{job}:cancel").status_code == 200
    assert limited.http("jobs", "POST", f"{job}:retry").status_code == 201
    assert is_limit(submit(limited, "jobs"), "unfinished_jobs")
    assert limited.refusals("unfinished_jobs") >= 2


def test_the_minutes_of_a_day_end_at_midnight(limited):
    ran(limited, "cpu")
    assert submit(limited, "minutes").status_code == 201
    ran(limited, "gpu")
    refused = submit(limited, "minutes")
    assert is_limit(refused, "compute_minutes_per_day")
    assert 0 < int(refused.headers["Retry-After"]) <= DAY_S + 2
    assert submit(limited, "polite").status_code == 201


@pytest.mark.long
def test_uploads_end_where_the_bytes_of_a_key_end(limited, scene_bytes, dataset_bytes):
    def put(who, path, content):
        return limited.http(who, "PUT", f"/v1/{path}", content=content)

    assert is_limit(put("bytes", "datasets/packed", dataset_bytes), "stored_gb")
    assert put("bytes", "scenes/one", scene_bytes).status_code == 201
    assert is_limit(put("bytes", "scenes/two", scene_bytes), "stored_gb")
    assert limited.http("bytes", "DELETE", "/v1/scenes/one").status_code == 204
    assert put("bytes", "scenes/two", scene_bytes).status_code == 201
    assert is_limit(put("unpacked", "datasets/unpacked", dataset_bytes), "stored_gb")
    stored = put("unlimited", "datasets/unpacked", dataset_bytes)
    assert stored.status_code == 201
    assert len(dataset_bytes) < 5000 < stored.json()["bytes"]
    for refused in (put("full", "scenes/full", scene_bytes), put("full", "datasets/full", dataset_bytes)):
        assert is_limit(refused, "stored_gb")
    assert is_limit(submit(limited, "full"), "stored_gb")


def test_a_key_keeps_only_so_many_registrations(limited):
    def put(who, name):
        body = {"scene": "demo", "base_to_scene": MATRIX}
        return limited.http(who, "PUT", f"/v1/registrations/{name}", json=body)

    assert [put("registrations", name).status_code for name in ("one", "two", "one")] == [200, 200, 200]
    assert is_limit(put("registrations", "three"), "registrations")
    assert put("unlimited", "three").status_code == 200
    assert limited.http("registrations", "DELETE", "/v1/registrations/one").status_code == 204
    assert put("registrations", "four").status_code == 200
    assert limited.refusals("registrations") == 1


BUSY = 6  # of OpenIGTLink


def refused(ask):
    """The first answer that is a refusal: a busy machine may be too slow to exceed a limit with the second."""

    def answer():
        response = ask()
        return None if response.status_code == 200 else response

    return wait_until(answer, every_s=0.0)


def refused_call(ask):
    def error():
        try:
            ask()
        except grpc.RpcError as error:
            return error
        return None

    return wait_until(error, every_s=0.0)


@contextmanager
def stream(limited, who):
    with connect(
        limited.service.stream_url(), additional_headers={"x-api-key": limited.keys[who]}, max_size=None
    ) as connection:
        yield connection


def send(connection, sequence, **more):
    connection.send(json.dumps({"sequence": sequence, "pose": POSE, **more}))


def receive(connection):
    message = connection.recv(timeout=300)
    return json.loads(message) if isinstance(message, str) else split(message)[0]


def test_requests_beyond_the_rate_are_refused_and_pass_after_the_time_that_is_told(limited):
    answer = refused(lambda: limited.http("requests", "GET", "/v1/scenes"))
    assert (answer.status_code, answer.json()["reason"]) == (429, "RATE_LIMITED")
    assert "1 requests a second (requests_per_s)" in answer.json()["detail"]
    assert limited.refusals("requests_per_s") >= 1
    assert limited.client.get("/v1/health/ready").status_code == 200  # which nobody counts
    time.sleep(int(answer.headers["Retry-After"]))
    assert limited.http("requests", "GET", "/v1/scenes").status_code == 200


def test_calls_of_grpc_count_as_requests(limited):
    stub = access_pb2_grpc.AccessServiceStub(limited.channel)

    def ask():
        return stub.WhoAmI(access_pb2.WhoAmIRequest(), metadata=limited.metadata("calls"), timeout=300)

    delay_s = retry_after_s(refused_call(ask), "RATE_LIMITED")
    assert 0.0 < delay_s < 1.1
    time.sleep(delay_s)
    ask()


def test_frames_beyond_the_rate_are_refused_and_pass_after_the_time_that_is_told(limited):
    answer = refused(lambda: limited.render("frames"))
    assert (answer.status_code, answer.json()["reason"]) == (429, "RATE_LIMITED")
    time.sleep(int(answer.headers["Retry-After"]))
    assert limited.render("frames").status_code == 200


def test_every_frame_of_a_batch_counts_and_the_batch_takes_the_seconds_that_it_needs(limited):
    began = time.monotonic()
    assert limited.render("poses", poses=[POSE] * 6).status_code == 200
    assert time.monotonic() - began >= 1.0
    hopeless = limited.render("poses", poses=[POSE] * 6, timeout_ms=500)
    assert (hopeless.status_code, hopeless.json()["reason"]) == (422, "TOO_MANY_POSES")
    began = time.monotonic()
    request = rendering_pb2.RenderBatchRequest(settings=render_settings(), poses=[moved(0)] * 6)
    frames = limited.renders().RenderBatch(request, metadata=limited.metadata("batch"), timeout=300)
    assert [frame.sequence for frame in frames] == list(range(6))
    assert time.monotonic() - began >= 1.0


def test_an_ordered_stream_waits_for_each_frame(limited):
    with stream(limited, "ordered") as connection:
        connection.send(json.dumps({"settings": SMALL}))
        began = time.monotonic()
        for sequence in range(6):
            send(connection, sequence)
        answers = [receive(connection) for _ in range(6)]
    assert time.monotonic() - began >= 1.0
    assert [answer["sequence"] for answer in answers] == list(range(6))
    assert not any("error" in answer for answer in answers)


def test_a_latest_stream_renders_the_newest_pose_whenever_it_may(limited):
    with stream(limited, "latest") as connection:
        connection.send(json.dumps({"settings": SMALL, "mode": "latest"}))
        send(connection, 0)
        send(connection, 1)
        answers = [receive(connection)]
        for sequence in range(2, 31):
            send(connection, sequence)
        while answers[-1]["sequence"] != 30:
            answers.append(receive(connection))
    assert not any("error" in answer for answer in answers)
    assert len(answers) < 10
    assert len(answers) + sum(answer["dropped"] for answer in answers) == 31


def test_streams_at_once_are_limited_over_all_doors(limited):
    def open_one():
        with stream(limited, "streams"):
            pass

    def call():
        request = rendering_pb2.RenderStreamRequest(settings=render_settings(), pose=moved(0))
        metadata = limited.metadata("streams")
        return list(limited.renders().RenderStream(iter([request]), metadata=metadata, timeout=300))

    with stream(limited, "streams"):
        with pytest.raises(InvalidStatus) as caught:
            open_one()
        document = json.loads(caught.value.response.body or b"")
        assert (document["reason"], document["status"]) == ("LIMIT_REACHED", 429)
        assert "Retry-After" not in caught.value.response.headers  # nobody knows when the other one ends
        with pytest.raises(grpc.RpcError) as refused:
            call()
        assert retry_after_s(refused.value, "LIMIT_REACHED") is None
        with stream(limited, "unlimited"), stream(limited, "unlimited"):
            pass  # the limit of all keys is not that of a key that has its own
    wait_until(lambda: _works(open_one))
    wait_until(lambda: _works(call))
    assert limited.refusals("streams") >= 2


def _works(open_stream):
    """Whether a stream opens: that of before ends on its own time."""
    try:
        open_stream()
    except (InvalidStatus, grpc.RpcError):
        return False
    return True


@pytest.fixture(scope="module")
def by_address(start_service):
    """Without keys: each address has limits of its own."""
    return start_service(igtl_port=0, igtl_scene="demo", key_streams=1, key_frames_per_s=2)


def test_without_keys_every_address_has_the_limits_of_a_key(by_address):
    body = {"pose": POSE, **SMALL}

    def client(source):
        return httpx.Client(base_url=by_address.http, transport=httpx.HTTPTransport(local_address=source), timeout=300)

    with client("127.0.0.4") as greedy, client("127.0.0.5") as polite:
        assert refused(lambda: greedy.post("/v1/scenes/demo/render", json=body)).status_code == 429
        assert polite.post("/v1/scenes/demo/render", json=body).status_code == 200


def test_openigtlink_is_limited_by_address(by_address):
    address = address_of(by_address)
    peer = Peer(address, source="127.0.0.2")
    second = Peer(address, source="127.0.0.2")
    status = second.status()
    assert (status.code, status.sub_code, status.name) == (BUSY, 429, "LIMIT_REACHED")
    assert second.is_closed()
    second.socket.close()
    Peer(address, source="127.0.0.3").socket.close()
    began = time.monotonic()
    for _ in range(3):  # an image comes before the next pose is sent
        peer.send_pose(np.eye(4))
        peer.image()
    assert time.monotonic() - began >= 1.0
    peer.socket.close()

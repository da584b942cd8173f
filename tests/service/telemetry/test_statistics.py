import json

import httpx
import pytest
from websockets.sync.client import connect

from ultragray_service.settings import load_settings
from ultragray_service.telemetry.metrics import STEP_S, STEPS, StageTimes, Statistics
from ultragray_service.wiring import make_service
from ultragray_workers.errors import DeadlineExceeded

POSE = {"position_mm": {"x": 0, "y": 1, "z": 0}, "quaternion": {"w": 1, "x": 0, "y": 0, "z": 0}}


class Clock:
    seconds = 1000.0

    def __call__(self):
        return self.seconds


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def statistics(clock):
    return Statistics(clock)


def test_each_step_tells_what_happened_in_it(statistics, clock):
    for render_ms in range(1, 101):
        statistics.observe(2, 1.0, float(render_ms), 2.0)
    clock.seconds += STEP_S
    statistics.count_error()
    summaries = statistics.summaries()
    assert [one.seconds_ago for one in summaries] == [STEP_S * age for age in range(STEPS - 1, -1, -1)]
    now, before = summaries[-1], summaries[-2]
    assert (now.frames, now.requests, now.errors, now.p50_ms) == (0, 0, 1, None)
    assert (before.frames, before.requests, before.errors) == (200, 100, 0)
    assert before.p50_ms == StageTimes(queue=1.0, render=51.0, encode=2.0)
    assert before.p99_ms == StageTimes(queue=1.0, render=100.0, encode=2.0)


def test_the_times_of_a_step_that_ended_are_worked_out_once(statistics, clock):
    for _ in range(1000):
        statistics.observe(1, 1.0, 2.0, 3.0)
    clock.seconds += STEP_S
    first = statistics.summaries()[-2]
    again = statistics.summaries()[-2]
    assert first == again
    assert first.p50_ms is again.p50_ms
    assert not statistics._steps[0].samples


def test_a_step_that_is_going_on_takes_more(statistics):
    for render_ms in (1.0, 3.0):
        statistics.observe(1, 1.0, render_ms, 2.0)
        summary = statistics.summaries()[-1]
        assert summary.p99_ms == StageTimes(queue=1.0, render=render_ms, encode=2.0)


def test_what_is_older_than_ten_minutes_goes(statistics, clock):
    statistics.observe(1, 1.0, 1.0, 1.0)
    clock.seconds += STEP_S * (STEPS - 1)
    assert statistics.summaries()[0].frames == 1
    clock.seconds += STEP_S
    assert sum(one.frames for one in statistics.summaries()) == 0


def test_many_requests_are_sampled(statistics):
    for place in range(5000):
        statistics.observe(1, 1.0, float(place % 100), 2.0)
    summary = statistics.summaries()[-1]
    assert summary.requests == 5000
    assert 35 < summary.p50_ms.render < 65


def test_over_http_only_what_the_service_could_not_do_is_an_error(start_service):
    service = start_service()
    stream = service.stream_url()
    with httpx.Client(base_url=service.http, timeout=300) as http, connect(stream) as websocket:

        def errors():
            return sum(step["errors"] for step in http.get("/v1/statistics").json()["steps"])

        websocket.send(json.dumps({"pose": {}}))
        assert json.loads(websocket.recv(timeout=300))["error"]["reason"] == "INVALID_POSE"
        assert http.post("/v1/scenes/demo/render", json={"pose": {}}).status_code == 422
        assert service.metric("ultragray_stream_frame_errors_total") == 1
        assert errors() == 0
        websocket.send(json.dumps({"pose": POSE, "timeout_ms": 0.001}))
        assert json.loads(websocket.recv(timeout=300))["error"]["reason"] == "DEADLINE_EXCEEDED"
        assert errors() == 1
        for _ in range(3):
            assert http.post("/v1/scenes/demo/render", json={"pose": POSE}).status_code == 200
        found = http.get("/v1/statistics").json()
    assert len(found["steps"]) == STEPS
    assert sum(step["frames"] for step in found["steps"]) == 3
    last = next(step for step in reversed(found["steps"]) if step["frames"])
    assert 0 < last["p50_ms"]["render"] <= last["p99_ms"]["render"]
    assert (found["processes"], found["loaded_scenes"], found["process_restarts"]) == (1, 1, 0)
    assert 50e6 < found["memory_bytes"] < 50e9


def test_a_refused_message_is_one_error(tmp_path):
    metrics = make_service(load_settings(data_folder=tmp_path)).metrics
    metrics.count_frame_error(DeadlineExceeded("too late"))  # OpenIGTLink counts a message as an answer as well
    metrics.count_request("igtl", "TRANSFORM", "DEADLINE_EXCEEDED", 0.1)
    assert sum(step.errors for step in metrics.statistics.summaries()) == 1

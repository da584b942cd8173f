"""What the service counts: for Prometheus, and for the console."""

from __future__ import annotations

import os
import random
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, fields
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from ultragray.contract import described
from ultragray.errors import UltragrayError
from ultragray.learn.localization.settings import Localization
from ultragray_service.access.principals import acting
from ultragray_service.errors import statuses_of
from ultragray_workers.jobs.store import JobsOverview
from ultragray_workers.pool.messages import RenderResult, SearchResult
from ultragray_workers.pool.pool import RenderPool

STEP_S = 5
STEPS = 120
_SAMPLES = 500  # of a step and stage; more are sampled


@dataclass(frozen=True)
class StageTimes:
    """The parts of the time of a request, ms."""

    queue: float
    render: float
    encode: float


STAGES = tuple(stage.name for stage in fields(StageTimes))


@dataclass
class _Step:
    start: int  # whole steps since the clock's zero
    frames: int = 0
    requests: int = 0
    errors: int = 0
    samples: dict[str, list[float]] = field(default_factory=lambda: {stage: [] for stage in STAGES})
    final: tuple[StageTimes, StageTimes] | None = None  # p50 and p99, in place of the samples, of a step that has ended

    def summary(self, age: int) -> StatisticsStep:
        """The step, which ended `age` steps ago; 0: it is going on."""
        p50_ms, p99_ms = self._quantiles(ended=age > 0) if self.requests else (None, None)
        return StatisticsStep(
            seconds_ago=age * STEP_S,
            frames=self.frames,
            requests=self.requests,
            errors=self.errors,
            p50_ms=p50_ms,
            p99_ms=p99_ms,
        )

    def _quantiles(self, *, ended: bool) -> tuple[StageTimes, StageTimes]:
        if self.final is not None:
            return self.final
        ordered = {stage: sorted(samples) for stage, samples in self.samples.items()}
        quantiles = _quantile(ordered, 0.5), _quantile(ordered, 0.99)
        if ended:
            self.final, self.samples = quantiles, {}
        return quantiles


@dataclass(frozen=True, kw_only=True)
class StatisticsStep:
    """The events of one step."""

    seconds_ago: int = described("0: it is going on; 5: it ended up to 5 s ago, and so on.")
    frames: int
    requests: int = described("Rendered ones; a request may have many frames.")
    errors: int = described(
        "Requests and messages that the service could not answer as asked: 429 and 5xx, not mistakes of clients."
    )
    p50_ms: StageTimes | None = described("null where nothing was rendered.")
    p99_ms: StageTimes | None


@dataclass(frozen=True, kw_only=True)
class ServiceStatistics:
    """The service now and in the last minutes."""

    step_s: int = described("Length of a step.", STEP_S)
    steps: list[StatisticsStep] = described("The oldest first.")
    waiting_frames: int
    busy_processes: int
    processes: int = described("Render processes alive.")
    process_restarts: int
    memory_bytes: int = described("Of the service and its render processes.")
    loaded_scenes: int
    version: str = described("Release of the service.")
    renderer: str | None = described("Name, version and backend of what rendered last; null: nothing was rendered yet.")
    jobs: dict[str, int] = described("By state, counted every 10 s; empty where that is not known.")


class Statistics:
    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._steps: deque[_Step] = deque(maxlen=STEPS)
        self._random = random.Random(0)

    def observe(self, frames: int, queue_ms: float, render_ms: float, encode_ms: float) -> None:
        step = self._now()
        step.frames += frames
        step.requests += 1
        for stage, milliseconds in zip(STAGES, (queue_ms, render_ms, encode_ms), strict=True):
            samples = step.samples[stage]
            if len(samples) < _SAMPLES:
                samples.append(milliseconds)
            elif (place := self._random.randrange(step.requests)) < _SAMPLES:
                samples[place] = milliseconds

    def count_error(self) -> None:
        self._now().errors += 1

    def summaries(self) -> list[StatisticsStep]:
        """The steps of the last minutes, the oldest first; one for each, also where nothing happened."""
        now = self._step_number()
        steps = {step.start: step for step in self._steps}
        return [(steps.get(now - age) or _Step(now - age)).summary(age) for age in range(STEPS - 1, -1, -1)]

    def _now(self) -> _Step:
        number = self._step_number()
        if not self._steps or self._steps[-1].start != number:
            self._steps.append(_Step(number))
        return self._steps[-1]

    def _step_number(self) -> int:
        return int(self._clock() // STEP_S)


def memory_bytes(pids: Iterable[int]) -> int:
    """Memory of this process and of others, shared pages counted once in each."""
    page = os.sysconf("SC_PAGE_SIZE")
    total = 0
    for pid in (os.getpid(), *pids):
        try:
            total += page * int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        except (OSError, IndexError, ValueError):  # gone a moment ago
            continue
    return total


def _quantile(ordered: dict[str, list[float]], share: float) -> StageTimes:
    place = {stage: min(int(share * len(samples)), len(samples) - 1) for stage, samples in ordered.items()}
    return StageTimes(**{stage: round(samples[place[stage]], 3) for stage, samples in ordered.items()})


_MILLISECONDS = (0.5, 1, 2, 4, 6, 8, 12, 16, 24, 32, 64, 125, 250, 500, 1000, 2000, 5000, 10_000, 30_000)
_SECONDS = tuple(ms / 1000 for ms in _MILLISECONDS)
_OVERLOADED = ("429", "RESOURCE_EXHAUSTED", "UNAVAILABLE", "DEADLINE_EXCEEDED", "INTERNAL")
_HEALTH_ROUTES = "/v1/health/"  # not ready is what they are asked for
MAX_SCENE_LABELS = 1000
OTHER_SCENES, PRIVATE_SCENES = ":other", ":private"  # no scene can have these names
_POSES = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024)


def _is_of_service(status: str) -> bool:
    """Whether a status of HTTP or gRPC says that the service could not answer, not that it was asked badly."""
    return status.startswith("5") or status in _OVERLOADED


class _Collector(Collector):
    """Asks a function when it is scraped."""

    def __init__(self, ask: Callable[[], Iterable[Metric]]) -> None:
        self._ask = ask

    def collect(self) -> Iterable[Metric]:
        return self._ask()


def _of_pool(pool: RenderPool) -> Iterator[Metric]:
    now, gauge, counter = pool.statistics(), GaugeMetricFamily, CounterMetricFamily
    yield gauge("ultragray_waiting_frames", "Frames that wait.", now.waiting_frames)
    yield gauge("ultragray_busy_processes", "Processes that render now.", now.busy)
    yield gauge("ultragray_processes_alive", "Render processes alive.", now.processes_alive)
    yield counter("ultragray_process_restarts", "Render processes replaced after they died.", now.restarts_total)
    kills = "Render processes that hung, were killed and replaced."
    yield counter("ultragray_watchdog_kills", kills, now.kills_total)
    stuck = "Render processes that have told nothing of their work for some seconds."
    yield gauge("ultragray_stuck_processes", stuck, now.stuck)
    yield gauge("ultragray_loaded_scenes", "Scenes that a process holds.", len(pool.loaded()))


def _of_jobs(now: JobsOverview) -> Iterator[Metric]:
    """What was counted last: a scrape asks no database."""
    oldest = "Time that the job has waited that waits longest, by the device that it asks for; 0 where none waits."
    for name, meaning, label, values in (
        ("ultragray_jobs", "Jobs, counted every 10 s.", "state", now.counts),
        ("ultragray_workers", "Workers of the jobs, likewise.", "state", now.workers),
        ("ultragray_oldest_waiting_job_seconds", oldest, "device", now.oldest_waiting_s),
    ):
        family = GaugeMetricFamily(name, meaning, labels=[label])
        for key, value in values.items():
            family.add_metric([getattr(key, "value", key)], value)
        yield family
    unfit = "Jobs that wait for a worker that is not there: none that is alive has what they ask for."
    yield GaugeMetricFamily("ultragray_unfit_jobs", unfit, now.unfit)


def _role() -> str:
    try:
        return acting().role.value
    except LookupError:  # a door that knows nobody
        return "none"


class Metrics:
    def __init__(self, is_private: Callable[[str], bool]) -> None:
        """`is_private`: whether a scene has an owner who keeps it to themselves, so that nobody reads its name here."""
        self._is_private = is_private
        self.registry = CollectorRegistry()
        self.statistics = Statistics()
        counter = partial(Counter, registry=self.registry)
        histogram = partial(Histogram, registry=self.registry)
        seconds = partial(histogram, buckets=_SECONDS)
        door = ["door", "route"]
        requests = "Requests answered; a stream counts once, at its end."
        self._requests = counter("ultragray_requests", requests, [*door, "status"])
        arrival = "From the arrival of a request to the end of its answer."
        self._request_seconds = seconds("ultragray_request_seconds", arrival, door)
        errors = "Messages of a stream that were answered with an error."
        self._frame_errors = counter("ultragray_stream_frame_errors", errors, ["reason"])
        self._streams = Gauge("ultragray_open_streams", "Streams of poses that are open.", registry=self.registry)
        dropped = "Poses of streams that newer ones replaced before they were rendered."
        self._dropped = counter("ultragray_stream_dropped_poses", dropped)
        frames = "Frames rendered, by the role of who asked for them."
        self._frames = counter("ultragray_frames", frames, ["scene", "role"])
        limited = (
            "Requests, frames, streams, jobs and uploads that a limit of their key refused, by the name of the limit."
        )
        self._limited = counter("ultragray_limited", limited, ["limit", "role"])
        self._scenes: set[str] = set()  # that have a label of their own
        self._queue = seconds("ultragray_queue_seconds", "Waiting time of a request before it was rendered.")
        self._render = seconds("ultragray_render_seconds", "Render time of the batch that a request was in.")
        self._encode = seconds("ultragray_encode_seconds", "Encoding time of a request's frames.")
        self._batch = histogram("ultragray_batch_poses", "Poses rendered together.", buckets=_POSES)
        searches = "Frames looked for in a scene, and whether they were found."
        self._searches = counter("ultragray_searches", searches, ["scene", "found"])
        self._search = seconds("ultragray_search_seconds", "Time that looking for a frame took, without its wait.")
        ProcessCollector(registry=self.registry)

    def read(self, pool: RenderPool, jobs: Callable[[], JobsOverview], scenes: Collector) -> None:
        """From now on each scrape reads these, too. `jobs`: in numbers, as they were counted last."""
        for collector in (_Collector(lambda: _of_pool(pool)), _Collector(lambda: _of_jobs(jobs())), scenes):
            self.registry.register(collector)

    def tell_certificate_expiry(self, not_after: Callable[[], datetime]) -> None:
        name, meaning = (
            "ultragray_certificate_expires_timestamp_seconds",
            "Unix time at which the TLS certificate in use expires.",
        )
        Gauge(name, meaning, registry=self.registry).set_function(lambda: not_after().timestamp())

    def count_request(self, door: str, route: str, status: str, seconds: float) -> None:
        self._requests.labels(door, route, status).inc()
        self._request_seconds.labels(door, route).observe(seconds)
        if door != "igtl" and _is_of_service(status) and not route.startswith(_HEALTH_ROUTES):
            self.statistics.count_error()

    def count_frame_error(self, error: UltragrayError) -> None:
        self._frame_errors.labels(error.reason).inc()
        if _is_of_service(str(statuses_of(error).http)):
            self.statistics.count_error()

    def count_stream(self, change: int) -> None:
        self._streams.inc(change)

    def count_dropped(self) -> None:
        self._dropped.inc()

    def count_limited(self, limit: str) -> None:
        self._limited.labels(limit, _role()).inc()

    def observe_result(self, result: RenderResult[Any]) -> None:
        self._frames.labels(self._label_of(result.scene), _role()).inc(len(result.poses))
        self._queue.observe(result.queue_ms / 1000)
        self._render.observe(result.render_ms / 1000)
        self._encode.observe(result.encode_ms / 1000)
        self._batch.observe(result.batch_size)
        self.statistics.observe(len(result.poses), result.queue_ms, result.render_ms, result.encode_ms)

    def observe_search(self, result: SearchResult[Localization]) -> None:
        self._searches.labels(self._label_of(result.scene), str(result.found.is_found).lower()).inc()
        self._search.observe(result.search_ms / 1000)

    def _label_of(self, scene: str) -> str:
        """The name of a public scene; OTHER_SCENES once so many had a label that more would fill the memory."""
        if self._is_private(scene):
            return PRIVATE_SCENES
        if scene not in self._scenes:
            if len(self._scenes) == MAX_SCENE_LABELS:
                return OTHER_SCENES
            self._scenes.add(scene)
        return scene

    def exposition(self) -> bytes:
        return generate_latest(self.registry)

"""One run of the simulation in figures, and the figures of several runs with their confidence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from . import queues
from .caches import Source
from .costs import SceneCosts
from .routing import PATIENCE_S, Routed
from .workload import Floats, Integers, Traffic, Workload

_STUDENTS_T = {3: 4.303, 5: 2.776}  # 97.5% quantiles of the t distribution, by the number of values


@dataclass(frozen=True)
class Outcome:
    """One run, in the window in which it is measured. Times in ms, from the sending of a pose to its frame."""

    hits: float  # share of requests and opening streams whose scene was in the replica's memory
    fetched_mb_per_s: float  # from object storage, by all replicas
    busy: float  # mean share of a replica's time that its work takes
    most_over_mean: float  # work of the busiest replica
    variation: float  # of the replicas' work, standard deviation over mean
    overfull: float  # share of replicas with more work than time
    wait_ms: float  # mean in the queue, as `ultragray_queue_seconds` counts it: of a pose since it came
    wait_p95_ms: float
    pose_p50_ms: float
    pose_p99_ms: float
    pose_p999_ms: float
    unanswered: float  # share of poses that a newer one replaced, or that were refused
    request_p50_ms: float  # of single requests and of the first pose of a stream
    request_p99_ms: float
    request_p999_ms: float
    refused: float  # share of requests
    replicas_of_hottest: float  # that were asked for the most popular scene


@dataclass(frozen=True)
class Window:
    """The time that is measured; what comes before fills the caches."""

    begin_s: float
    end_s: float

    @property
    def length_s(self) -> float:
        return self.end_s - self.begin_s


@dataclass(frozen=True)
class _Work:
    """What replicas have to do in the window, sorted by replica, then by time."""

    replica: Integers  # [N]
    arrival_s: Floats  # [N] in the queue
    asked_s: Floats  # [N]
    work_s: Floats  # [N]
    overhead_s: Floats  # [N]
    stream: Integers  # [N] its asking; queues.ALONE of a request


def evaluate(
    routed: Routed,
    traffic: Traffic,
    workload: Workload,
    kinds: Sequence[SceneCosts],
    speeds: Sequence[float],
    alive: Sequence[int],
    window: Window,
    random: np.random.Generator,
) -> Outcome:
    """The figures of a run. `alive`: the replicas at its end."""
    work = _work(routed, traffic, workload, kinds, np.asarray(speeds), window, random)
    begun = np.empty(len(work.replica))
    bounds = np.searchsorted(work.replica, np.arange(len(speeds) + 1))
    for first, stop in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
        part = slice(first, stop)
        begun[part] = queues.begins(work.arrival_s[part], work.work_s[part], work.stream[part], patience_s=PATIENCE_S)
    answered = ~np.isnan(begun)
    of_stream = work.stream != queues.ALONE
    poses, requests = answered & of_stream, answered & ~of_stream
    waits_ms = 1000.0 * (begun - work.arrival_s)[answered]
    taken_ms = 1000.0 * (begun - work.asked_s + work.work_s + work.overhead_s)
    busy = np.bincount(work.replica, work.work_s, minlength=len(speeds))[list(alive)] / window.length_s
    asked, source = np.array(routed.asked_s), np.array(routed.source)
    inside = (asked >= window.begin_s) & (asked < window.end_s)
    scenes = np.array(routed.scene)
    sizes = np.array([kind.file_bytes for kind in kinds])[traffic.large[scenes].astype(int)]
    of_hottest = np.array(routed.replica)[inside & (scenes == 0)]
    return Outcome(
        hits=float((source[inside] == Source.MEMORY).mean()),
        fetched_mb_per_s=float(sizes[inside & (source == Source.STORAGE)].sum() / 1e6 / window.length_s),
        busy=float(busy.mean()),
        most_over_mean=float(busy.max() / busy.mean()),
        variation=float(busy.std() / busy.mean()),
        overfull=float((busy > 1.0).mean()),
        wait_ms=float(waits_ms.mean()),
        wait_p95_ms=float(np.quantile(waits_ms, 0.95)),
        **_quantiles("pose", taken_ms[poses]),
        unanswered=float(1.0 - poses.sum() / of_stream.sum()),
        **_quantiles("request", taken_ms[requests]),
        refused=float(1.0 - requests.sum() / (~of_stream).sum()),
        replicas_of_hottest=float(len(np.unique(of_hottest))),
    )


def _quantiles(what: str, times_ms: Floats) -> dict[str, float]:
    p50, p99, p999 = np.quantile(times_ms, [0.5, 0.99, 0.999])
    return {f"{what}_p50_ms": float(p50), f"{what}_p99_ms": float(p99), f"{what}_p999_ms": float(p999)}


def _work(
    routed: Routed,
    traffic: Traffic,
    workload: Workload,
    kinds: Sequence[SceneCosts],
    speeds: Floats,
    window: Window,
    random: np.random.Generator,
) -> _Work:
    asked, ready, end = (np.array(one) for one in (routed.asked_s, routed.ready_s, routed.end_s))
    replica, scene, source = (np.array(one) for one in (routed.replica, routed.scene, routed.source))
    first = np.flatnonzero((ready >= window.begin_s) & (ready < window.end_s))
    begin = np.maximum(ready, window.begin_s)
    until = np.minimum(end, window.end_s)
    period = 1.0 / workload.poses_per_s
    begin = begin + random.uniform(0.0, period, len(begin))
    counts = np.where(end > 0.0, np.maximum(0, np.ceil((until - begin) / period)), 0).astype(np.int64)
    of = np.repeat(np.arange(len(counts)), counts)
    number = np.arange(len(of)) - np.repeat(np.cumsum(counts) - counts, counts)
    sent = begin[of] + number * period
    asking = np.concatenate([first, of])
    arrival = np.concatenate([ready[first], sent])
    large = traffic.large[scene[asking]].astype(int)
    frame, spread, overhead, load = (
        np.array([getattr(kind, name) for kind in kinds])[large]
        for name in ("frame_s", "spread", "overhead_s", "load_s")
    )
    loads = np.concatenate([source[first] != Source.MEMORY, np.zeros(len(of), np.bool_)])
    taken = frame * np.exp(spread * random.standard_normal(len(asking)) - spread**2 / 2.0)
    order = np.lexsort((arrival, replica[asking]))
    return _Work(
        replica=replica[asking][order],
        arrival_s=arrival[order],
        asked_s=np.concatenate([asked[first], sent])[order],
        work_s=((taken + np.where(loads, load, 0.0)) / speeds[replica[asking]])[order],
        overhead_s=overhead[order],
        stream=np.concatenate([np.full(len(first), queues.ALONE), of])[order],
    )


def with_confidence(outcomes: Sequence[Outcome]) -> dict[str, list[float]]:
    """Of each figure the mean over runs, and half the width of its 95% confidence interval."""
    return {
        field.name: mean_with_confidence([getattr(one, field.name) for one in outcomes]) for field in fields(Outcome)
    }


def mean_with_confidence(values: Sequence[float]) -> list[float]:
    """The mean of 3 or 5 independent values, and half the width of its 95% confidence interval."""
    half = _STUDENTS_T[len(values)] * float(np.std(values, ddof=1)) / math.sqrt(len(values))
    return [float(f"{np.mean(values):.5g}"), float(f"{half:.2g}")]

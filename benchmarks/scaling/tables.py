"""The figures of the simulation as Markdown: a mean over the runs ± half the width of its 95% confidence interval."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from .defaults import DEFAULTS

Lines = Callable[[dict[str, Any]], Iterator[str]]
Format = Callable[[float, float], str]


def _number(digits: int) -> Format:
    return lambda mean, half: f"{mean:,.{digits}f} ± {half:,.{digits}f}"


def _share(digits: int) -> Format:
    return lambda mean, half: f"{100.0 * mean:.{digits}f} ± {100.0 * half:.{digits}f}%"


# Of each figure of an Outcome: the head of its column, and how it is written.
_FIGURES: dict[str, tuple[str, Format]] = {
    "hits": ("Hits", _share(1)),
    "fetched_mb_per_s": ("Fetched MB/s", _number(0)),
    "busy": ("Replicas busy", _share(0)),
    "most_over_mean": ("Busiest / mean", _number(2)),
    "variation": ("Variation", _number(2)),
    "overfull": ("Overfull", _share(1)),
    "wait_ms": ("Mean wait ms", _number(1)),
    "wait_p95_ms": ("Wait p95 ms", _number(1)),
    "pose_p50_ms": ("Pose p50 ms", _number(1)),
    "pose_p99_ms": ("Pose p99 ms", _number(1)),
    "pose_p999_ms": ("Pose p99.9 ms", _number(0)),
    "unanswered": ("Unanswered", _share(2)),
    "request_p50_ms": ("Request p50 ms", _number(0)),
    "request_p99_ms": ("Request p99 ms", _number(0)),
    "request_p999_ms": ("Request p99.9 ms", _number(0)),
    "refused": ("Refused", _share(1)),
    "replicas_of_hottest": ("Replicas of the hottest scene", _number(0)),
}
_BALANCE = ("hits", "fetched_mb_per_s", "most_over_mean", "variation", "overfull")
_POSES = ("pose_p50_ms", "pose_p99_ms", "pose_p999_ms", "unanswered")
_REQUESTS = ("request_p50_ms", "request_p99_ms", "request_p999_ms", "refused")
_BRIEFLY = (*_BALANCE, "pose_p99_ms", "unanswered", "request_p99_ms")

# Of each study: the head of its first column, and the figures that it shows.
STUDIES: dict[str, tuple[str, tuple[str, ...]]] = {
    "balance": ("Policy", (*_BALANCE, "replicas_of_hottest")),
    "latency": ("Policy", (*_POSES, *_REQUESTS)),
    "exponents": ("Policy; exponent", (*_BRIEFLY, "replicas_of_hottest")),
    "factors": ("Bound of the mean", (*_BRIEFLY, "replicas_of_hottest")),
    "rings": ("Points of the ring", _BRIEFLY),
    "doors": ("Replicas are hashed", _BRIEFLY),
    "hot scenes": ("Keys of each of the 10 hottest scenes", (*_BRIEFLY, "replicas_of_hottest")),
    "proxies": ("Envoys that share the clients", _BRIEFLY),
    "caches": ("Memory of each replica for scenes", ("hits", "fetched_mb_per_s", "busy", *_POSES[1:], *_REQUESTS[:3])),
    "load": ("Streams for each replica", ("busy", "overfull", "wait_ms", "wait_p95_ms", *_POSES, "request_p99_ms")),
    "changes": ("Policy", ("hits", "fetched_mb_per_s", "overfull", *_POSES[1:], *_REQUESTS[1:])),
    "speeds": ("Policy", _BRIEFLY),
}
_OF_POLICIES = ("balance", "latency")


def study(name: str) -> Lines:
    """The table of a study."""
    return partial(_study, name)


def _study(name: str, document: dict[str, Any]) -> Iterator[str]:
    head, figures = STUDIES[name]
    rows = document["studies"]["policies" if name in _OF_POLICIES else name]
    yield f"| {head} | {' | '.join(_FIGURES[figure][0] for figure in figures)} |"
    yield "|---" * (len(figures) + 1) + "|"
    for row, found in rows.items():
        cells = [_FIGURES[figure][1](*found[figure]) for figure in figures]
        yield f"| {row} | {' | '.join(cells)} |"


def costs(document: dict[str, Any]) -> Iterator[str]:
    """What went into the simulation."""
    yield "| Gaussians | Frame ms | Door ms | Load ms | In memory MB | File MB |"
    yield "|---|---|---|---|---|---|"
    for one in document["costs"]:
        times = [f"{1000.0 * one[name]:.2f}" for name in ("frame_s", "overhead_s")]
        sizes = [f"{one[name] / 1e6:.1f}" for name in ("resident_bytes", "file_bytes")]
        yield f"| {one['gaussians']:,} | {' | '.join(times)} | {1000.0 * one['load_s']:.0f} | {' | '.join(sizes)} |"


def checks(document: dict[str, Any]) -> Iterator[str]:
    """The simulation beside known answers."""
    yield "| What | Known | Simulated |"
    yield "|---|---|---|"
    for name, found in document["checks"].items():
        yield f"| {name} | {found['known']:.3f} | {_number(3)(*found['simulated'])} |"


def defaults(_: dict[str, Any]) -> Iterator[str]:
    """What was decided."""
    one_home = "each replica's own name" if DEFAULTS.one_home else "address and port"
    yield "| Setting | Value |"
    yield "|---|---|"
    yield f"| Envoy: `hash_balance_factor` | {DEFAULTS.hash_balance_factor} |"
    yield f"| Envoy: `minimum_ring_size` | {DEFAULTS.minimum_ring_size} |"
    yield f"| Envoy: replicas are hashed by | {one_home} |"
    yield f"| Envoy: keys of a hot scene | {DEFAULTS.keys_of_hot_scene}: the bound spreads it |"
    yield f"| Replica: `memory_budget_mb` | {DEFAULTS.memory_budget_mb} |"
    yield f"| More replicas where 5% of `ultragray_queue_seconds` are above | {DEFAULTS.queue_p95_ms:g} ms |"
    yield f"| which is where replicas are busy for | {100.0 * DEFAULTS.utilisation:.0f}% of their time |"

"""Clients: control loops that keep a stream open, and others that ask for a frame now and then."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

GRPC, HTTP = 0, 1  # doors: each has a port of its own, and so a cluster of its own in Envoy


@dataclass(frozen=True)
class Workload:
    """What is asked for; `exponent` is Zipf's: the r-th scene is asked for r^-exponent as often as the first."""

    scenes: int = 10_000
    exponent: float = 1.0
    clients: int = 100_000
    streaming_share: float = 0.05  # of the clients at any time
    websocket_share: float = 0.5  # of the streams; the others are gRPC's
    stream_s: float = 120.0  # mean time that a stream is open
    poses_per_s: float = 30.0  # of a stream
    request_every_s: float = 20.0  # mean, of a client without a stream
    large_share: float = 0.2  # of the scenes; the others are small

    @property
    def streams(self) -> int:
        """Streams that are open at any time."""
        return round(self.clients * self.streaming_share)

    @property
    def requests_per_s(self) -> float:
        """Single frames of all clients."""
        return (self.clients - self.streams) / self.request_every_s


@dataclass(frozen=True)
class Traffic:
    """All that is asked for, in order of time. A single request has a length of 0."""

    time_s: Floats  # [N]
    scene: Integers  # [N], 0 for the most popular
    length_s: Floats  # [N]
    door: Integers  # [N]
    proxy: Integers  # [N] the Envoy that the client reaches
    large: npt.NDArray[np.bool_]  # [scenes]


def popularity(workload: Workload) -> Floats:  # [scenes]
    """The share of each scene in all that is asked for."""
    weights = np.arange(1, workload.scenes + 1, dtype=np.float64) ** -workload.exponent
    return np.asarray(weights / weights.sum())


def draw_traffic(workload: Workload, horizon_s: float, proxies: int, random: np.random.Generator) -> Traffic:
    """The traffic of `horizon_s` seconds. At 0 as many streams open as are open at any time."""
    openings = random.poisson(workload.streams / workload.stream_s * horizon_s)
    requests = random.poisson(workload.requests_per_s * horizon_s)
    streams = workload.streams + openings
    count = streams + requests
    time_s = np.concatenate([np.zeros(workload.streams), random.uniform(0.0, horizon_s, openings + requests)])
    length_s = np.concatenate([random.exponential(workload.stream_s, streams), np.zeros(requests)])
    by_grpc = np.concatenate([random.random(streams) >= workload.websocket_share, np.zeros(requests, np.bool_)])
    order = np.argsort(time_s, kind="stable")
    return Traffic(
        time_s=time_s[order],
        scene=random.choice(workload.scenes, count, p=popularity(workload)),
        length_s=length_s[order],
        door=np.where(by_grpc, GRPC, HTTP)[order],
        proxy=random.integers(proxies, size=count),
        large=random.random(workload.scenes) < workload.large_share,
    )

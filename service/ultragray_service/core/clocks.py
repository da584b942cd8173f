"""The clock of a stream's client beside that of the service, from the messages that the stream carries anyway.

Two messages make four stamps, as of NTP (RFC 5905, section 8):

    service ── answer, sent at s₁ ──► client, there at c₁  …  sent at c₂ ── message ──► service, there at s₂

The round trip takes δ = (s₂ − s₁) − (c₂ − c₁). The client's clock is ahead of the service's by

    θ = ((c₁ − s₁) + (c₂ − s₂)) / 2

give or take δ/2, by however much one way was longer than the other. So the fastest round trip of each second is kept,
and a line in time, offset and drift, is fitted to those of the last minute: each counts as far as it may be off,
(δ − least δ)/2. That both ways of the fastest one took as long as each other nobody can tell: half of it is uncertain.
"""

from __future__ import annotations

import math
import time
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ultragray.contract import described

_BEGUN_S = time.time() - time.monotonic()
_KEPT = 60  # round trips
_BETWEEN_S = 1.0  # of each such time the fastest one
_RESOLUTION_S = 5e-5  # of stamps that programs take
_USUAL_DRIFT = 1e-4  # of clocks of computers, standard deviation
_SLACK_S = 1e-3  # beyond what a round trip allows, and the client's clock was set
_MOST_S = 60.0  # of a round trip, and of a wait for the client's next message


def service_time_s() -> float:
    """Seconds since 1970 by the service's clock, which is never set while the service runs."""
    return _BEGUN_S + time.monotonic()


@dataclass(frozen=True)
class ClockOffset:
    """The client's clock beside the service's, as it is when the answer is sent."""

    offset_ms: float = described("Client's time minus service's.")
    uncertainty_ms: float = described(
        "The offset is off by no more: half of the fastest round trip, and the standard deviation of the fit."
    )
    drift_ppm: float = described("What the client's clock gains, microseconds a second.")


class ClockStamps(NamedTuple):
    """The first three of the four stamps, in seconds: the answer's by the service's clock, others by the client's."""

    answer_sent_s: float
    answer_arrived_s: float
    sent_s: float


class _RoundTrip(NamedTuple):
    at_s: float  # of the service
    offset_s: float
    took_s: float


class _Line(NamedTuple):
    """The client's clock beside the service's, as far as it is known: a line in time, through the newest round trip."""

    at_s: float  # of the service
    offset_s: float  # then
    drift: float
    least_s: float  # the fastest round trip
    variance: float  # of the offset then, s²
    covariance: float  # of offset and drift, s
    drift_variance: float

    def offset(self, at_s: float) -> tuple[float, float]:
        """The offset at a time, and its uncertainty, in seconds."""
        later_s = at_s - self.at_s
        variance = self.variance + later_s * (2.0 * self.covariance + later_s * self.drift_variance)
        return self.offset_s + later_s * self.drift, self.least_s / 2.0 + math.sqrt(variance)


class ClientClock:
    """The clock of one client, of which nothing is known at first."""

    def __init__(self) -> None:
        self._trips: deque[_RoundTrip] = deque(maxlen=_KEPT)
        self._best_since_s = 0.0
        self._line: _Line | None = None  # of these round trips

    def observe(self, stamps: ClockStamps, arrived_s: float) -> None:
        """Takes the stamps of a message, and when it arrived here. What cannot be is left out."""
        waited_s = stamps.sent_s - stamps.answer_arrived_s
        took_s = arrived_s - stamps.answer_sent_s - waited_s
        if not (0.0 <= took_s <= _MOST_S and 0.0 <= waited_s <= _MOST_S):
            return
        offset_s = (stamps.answer_arrived_s - stamps.answer_sent_s + stamps.sent_s - arrived_s) / 2.0
        trip = _RoundTrip(arrived_s - (took_s + waited_s) / 2.0, offset_s, took_s)
        if self._line is not None:
            expected_s, uncertainty_s = self._line.offset(trip.at_s)
            if abs(offset_s - expected_s) > took_s / 2.0 + uncertainty_s + _SLACK_S:
                self._trips.clear()
        if not self._trips or trip.at_s - self._best_since_s >= _BETWEEN_S:
            self._trips.append(trip)
            self._best_since_s = trip.at_s
        elif trip.took_s < self._trips[-1].took_s:
            self._trips[-1] = trip
        else:
            return
        self._line = _fitted(self._trips)

    def offset(self, at_s: float) -> ClockOffset | None:
        """The offset at a time of the service; None: no round trip is known yet."""
        if self._line is None:
            return None
        offset_s, uncertainty_s = self._line.offset(at_s)
        return ClockOffset(round(1e3 * offset_s, 3), round(1e3 * uncertainty_s, 3), round(1e6 * self._line.drift, 1))


def _fitted(trips: deque[_RoundTrip]) -> _Line:
    """Weighted least squares, no drift being likely."""
    times_s, offsets_s, took_s = np.array(trips).T
    least_s, first_s = took_s.min(), offsets_s[-1]
    weights = ((took_s - least_s) / 2.0 + _RESOLUTION_S) ** -2.0
    columns = np.stack([np.ones_like(times_s), times_s - times_s[-1]], axis=1)
    normal = (weights * columns.T) @ columns + np.diag([0.0, _USUAL_DRIFT**-2])
    inverse = np.linalg.inv(normal)
    offset_s, drift = inverse @ (weights * columns.T) @ (offsets_s - first_s)  # small numbers of large ones
    (variance, covariance), (_, drift_variance) = inverse
    values = times_s[-1], first_s + offset_s, drift, least_s, variance, covariance, drift_variance
    return _Line(*map(float, values))

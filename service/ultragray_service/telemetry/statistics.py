"""The last minutes of the service in steps of a few seconds, for people who look: Prometheus keeps the rest."""

from __future__ import annotations

import os
import random
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields
from pathlib import Path

from ultragray.contract import described

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

    def quantiles(self, *, ended: bool) -> tuple[StageTimes, StageTimes] | tuple[None, None]:
        if not self.requests:
            return None, None
        if self.final is not None:
            return self.final
        ordered = {stage: sorted(samples) for stage, samples in self.samples.items()}
        found = _quantile(ordered, 0.5), _quantile(ordered, 0.99)
        if ended:
            self.final, self.samples = found, {}
        return found


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
    """A ring of steps. Belongs to one event loop."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._steps: deque[_Step] = deque(maxlen=STEPS)
        self._random = random.Random(0)

    def observe(self, frames: int, queue_ms: float, render_ms: float, encode_ms: float) -> None:
        """One rendered request of the pool."""
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
        """One request or message that the service could not answer as asked."""
        self._now().errors += 1

    def summaries(self) -> list[StatisticsStep]:
        """The steps of the last minutes, the oldest first; one for each, also where nothing happened."""
        now = self._step_number()
        found = {step.start: step for step in self._steps}
        return [_summary(found.get(now - age) or _Step(now - age), age) for age in range(STEPS - 1, -1, -1)]

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


def _summary(step: _Step, age: int) -> StatisticsStep:
    p50_ms, p99_ms = step.quantiles(ended=age > 0)
    return StatisticsStep(
        seconds_ago=age * STEP_S,
        frames=step.frames,
        requests=step.requests,
        errors=step.errors,
        p50_ms=p50_ms,
        p99_ms=p99_ms,
    )


def _quantile(ordered: dict[str, list[float]], share: float) -> StageTimes:
    return StageTimes(
        **{
            stage: round(samples[min(int(share * len(samples)), len(samples) - 1)], 3)
            for stage, samples in ordered.items()
        }
    )

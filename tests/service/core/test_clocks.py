"""The clock of a stream's client, found from stamps of a clock and a network that are made up."""

import numpy as np
import pytest

from ultragray_service.core.clocks import ClientClock, ClockStamps

BEGUN_S = 1.8e9  # by the service's clock


class Exchange:
    """Messages and answers of a client whose clock is ahead and drifts, by ways of random length."""

    def __init__(self, *, offset_s=37.0, drift_ppm=0.0, there_s=(0.002, 0.0), back_s=(0.002, 0.0)):
        self.clock, self.random = ClientClock(), np.random.default_rng(0)
        self.offset_s, self.drift_ppm, self.there_s, self.back_s = offset_s, drift_ppm, there_s, back_s
        self.now_s = BEGUN_S

    def true_offset_s(self, at_s):
        return self.offset_s + 1e-6 * self.drift_ppm * (at_s - BEGUN_S)

    def way_s(self, way):
        least, jitter = way
        return least + self.random.exponential(jitter)

    def run(self, seconds, every_s=0.02):
        for _ in range(round(seconds / every_s)):
            there = self.now_s + self.way_s(self.back_s)
            left = there + 0.004
            arrived = left + self.way_s(self.there_s)
            stamps = (self.now_s, there + self.true_offset_s(there), left + self.true_offset_s(left))
            self.clock.observe(ClockStamps(*stamps), arrived)
            self.now_s += every_s
        return self.clock.offset(self.now_s)

    def error_ms(self, found):
        return found.offset_ms - 1e3 * self.true_offset_s(self.now_s)


@pytest.mark.parametrize("offset_s", [0.0, 37.0, -37.0, 1.8e9])
def test_an_offset_is_found_although_one_way_jitters_by_fifty_milliseconds(offset_s):
    exchange = Exchange(offset_s=offset_s, there_s=(0.002, 0.05), back_s=(0.002, 0.001))
    found = exchange.run(10.0)
    assert abs(exchange.error_ms(found)) < 1.0
    assert abs(exchange.error_ms(found)) <= found.uncertainty_ms < 5.0


def test_a_faster_round_trip_counts_at_once():
    exchange = Exchange(there_s=(0.050, 0.0), back_s=(0.002, 0.0))
    assert exchange.run(0.1).uncertainty_ms > 20.0
    exchange.there_s = (0.002, 0.0)
    assert abs(exchange.error_ms(found := exchange.run(0.1))) <= found.uncertainty_ms < 5.0


@pytest.mark.parametrize("drift_ppm", [-60.0, 0.0, 60.0])
def test_a_drift_is_told_and_followed(drift_ppm):
    exchange = Exchange(drift_ppm=drift_ppm, there_s=(0.002, 0.02), back_s=(0.002, 0.005))
    found = exchange.run(60.0)
    assert found.drift_ppm == pytest.approx(drift_ppm, abs=15.0)
    exchange.now_s += 10.0  # of silence, in which the clocks go 0.6 ms apart
    assert abs(exchange.error_ms(exchange.clock.offset(exchange.now_s))) < 0.5


def test_a_way_that_is_always_longer_than_the_other_is_within_what_is_told_to_be_uncertain():
    exchange = Exchange(there_s=(0.030, 0.001), back_s=(0.002, 0.001))
    found = exchange.run(5.0)
    assert 10.0 < abs(exchange.error_ms(found)) <= found.uncertainty_ms


def test_a_clock_that_is_set_is_found_anew():
    exchange = Exchange()
    exchange.run(20.0)
    exchange.offset_s = -5.0
    assert abs(exchange.error_ms(exchange.run(0.1))) < 0.1


def test_stamps_that_cannot_be_say_nothing():
    clock = ClientClock()
    clock.observe(ClockStamps(BEGUN_S, 10.0, 9.0), BEGUN_S + 1.0)  # sent before the answer came
    clock.observe(ClockStamps(BEGUN_S + 5.0, 10.0, 10.0), BEGUN_S)  # an answer that is not sent yet
    clock.observe(ClockStamps(BEGUN_S, 10.0, 13.0), BEGUN_S + 1.0)  # the client waited longer than all of it took
    clock.observe(ClockStamps(0.0, 10.0, 13.0), BEGUN_S)  # an answer of decades ago
    assert clock.offset(BEGUN_S) is None

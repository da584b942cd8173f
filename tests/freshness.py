"""Poses at 60 Hz through a door, and how old the frames are when a reader takes them, however slowly."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import Protocol

from .waiting import at_this_load

PERIOD_S = 1 / 60
SPARE_S = 0.15  # beside the reader's own period
# Between one reading and the next: at once, quickly, slowly, after a long stall, and slowly again.
PAUSES_S = (*[0.0] * 20, *[0.05] * 5, *[0.3] * 2, 1.0, *[0.05] * 5)


class Door(Protocol):
    """One client's latest stream."""

    def send(self):
        """Sends a pose, with the time as it is."""

    def receive(self):
        """Takes a frame; the time.monotonic() of its pose."""


@dataclass(frozen=True)
class Reading:
    """One frame that was taken."""

    pause_s: float  # since the reading before
    age_s: float  # of its pose


def read_slowly(door):
    """The frames that a reader takes, with pauses, while poses come at 60 Hz."""
    stop = threading.Event()

    def send():
        while not stop.wait(PERIOD_S):
            door.send()

    sender = threading.Thread(target=send)
    sender.start()
    try:
        door.receive()  # the scene is loaded by then
        readings, last = [], time.monotonic()
        for pause_s in PAUSES_S:
            time.sleep(pause_s)
            begun = time.monotonic()
            measured = door.receive()
            now = time.monotonic()
            readings.append(Reading(begun - last, now - measured))
            last = now
        return readings
    finally:
        stop.set()
        sender.join()


def check_fresh(door, pauses=1):
    """No frame is older than the reader's own pause, or so many of its last pauses, and 150 ms."""
    readings = read_slowly(door)
    spare_s = at_this_load(SPARE_S)
    old = {}
    for index, one in enumerate(readings):
        last = readings[max(0, index + 1 - pauses) : index + 1]
        if one.age_s > sum(reading.pause_s for reading in last) + spare_s:
            old[index] = one
    assert not old, f"older than {pauses} pauses and {spare_s:.3f} s: {old}"

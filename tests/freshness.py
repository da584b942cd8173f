"""Whether frames of a latest stream are of the newest poses when a reader takes them, however seldom it does."""

from __future__ import annotations

from typing import Protocol

# How many poses are sent between one reading and the next: at once, quickly, slowly, after a long stall, slowly again.
POSES = (*[1] * 20, *[3] * 5, *[20] * 2, 200, *[5] * 10)


class Door(Protocol):
    """One client's latest stream."""

    def send(self, number: int) -> None:
        """Sends the pose of a number."""

    def receive(self) -> int:
        """Takes a frame; the number of its pose."""


def check_fresh(door, ahead=1):
    """Each frame was rendered after the reader had taken the one that was so many before it, from the newest pose.

    `ahead`: 1 where the service knows what the reader has taken; else what lies in buffers on the way counts, too.
    """
    sent, taken = 0, []
    for count in POSES:
        for _ in range(count):
            sent += 1
            door.send(sent)
        taken.append((door.receive(), sent))
    old = {}
    for index, (number, _) in enumerate(taken[ahead:]):
        _, sent_before = taken[index]
        if number < sent_before:
            old[index + ahead] = number, sent_before
    assert not old, f"frames by their place, each of an older pose than was sent before: {old}"

"""Whether frames of a latest stream are of the newest poses when a reader takes them, however seldom it does."""

from typing import Protocol

# How many poses come between one reading and the next: the reader keeps up, is slow, stalls, and is slow again.
POSES = (*[1] * 10, *[3] * 5, 30, *[3] * 10)


# A service that does not guess: it takes frames for read when they were, however slow a reader and the machine are.
WAITS = {"core.unread._QUIET_S": 3600.0, "core.unread._LONGEST_S": 3600.0}


class Door(Protocol):
    """One client's latest stream."""

    def send(self, number: int) -> None:
        """Sends the pose of a number, and returns once the service has it."""

    def receive(self) -> int:
        """Takes a frame; the number of its pose."""


def check_fresh(door, *, excused=0):
    """Each frame is of the newest pose of when the reader took the one before it, or of a newer one.

    `excused`: so many may be older, where only the window of the reader's kernel tells what was read. That kernel may
    widen its window on its own: one of 130 connections on a busy machine has a frame sent ahead for it.
    """
    sent, before, old = 0, 0, {}
    for reading, count in enumerate(POSES):
        for _ in range(count):
            sent += 1
            door.send(sent)
        number = door.receive()
        if number < before:
            old[reading] = number, before
        before = sent
    assert len(old) <= excused, (
        f"by reading: the pose of its frame, and the newest that was there at the reading before: {old}"
    )

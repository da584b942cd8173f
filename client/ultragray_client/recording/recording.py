"""A recording of received frames: an MCAP file with the topics of those that the service's jobs write."""

from __future__ import annotations

import contextlib
import os
import secrets
import threading
import weakref
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import TypeAlias

from ..errors import ExtraMissing, InvalidArgument
from ..frames import Frame, origin_of

FRAME_TIME_NS = 40_000_000  # between frames without a time of their own, as in the files of jobs
MAX_TIME_NS = 2**31 * 1_000_000_000  # the seconds of a stamp have 31 bits


class Recording:
    """Writer of an MCAP file of frames as they come, of either client; messages of ROS 2. The extra `mcap`.

    The file takes its name when the recording is closed, whatever ended it: an error in the `with` keeps the frames
    until then. Only a program that is killed, or a disk that is full, leaves no file of that name. A file that had the
    name is replaced.
    """

    def __init__(self, path: str | Path) -> None:
        """Begin a file. Raises ExtraMissing without the extra, OSError."""
        try:
            from .writer import RosRecording
        except ImportError as error:
            raise ExtraMissing(
                f"a recording needs {error.name or 'mcap'}, which is not installed: "
                "pip install 'ultragray-client[mcap]'"
            ) from error
        self._path = Path(path)
        self._temporary = self._path.with_name(f".{self._path.name}.{secrets.token_hex(8)}.tmp")
        self._file = self._temporary.open("xb")
        self._next_ns = 0
        self._is_writable = True
        with self._giving_up_on_error():
            self._writer = RosRecording(self._file)
        # Ctrl-C interrupts the caller, not this thread: no message is half written. Only queues lie between them, as an
        # interrupt may leave the locks of an executor held.
        self._work: SimpleQueue[_Work | None] = SimpleQueue()
        threading.Thread(target=_do_all, args=(self._work,), name="recording", daemon=True).start()
        self._end = weakref.finalize(self, self._work.put, None)

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def add(self, frame: Frame, *, time_ns: int | None = None) -> None:
        """Write a frame with its pose, its geometry and its confidence.

        `time_ns`: the stamp of its pose, ns since 1970; None: 40 ms after the frame before, the first at 0, as frames
        in the files of jobs. Blocks while a megabyte is compressed, now and then. Raises InvalidArgument for another
        time and for a recording that is closed, OSError.
        """
        if not self._is_writable:
            raise InvalidArgument(f"the recording {self._path} is closed")
        stamp_ns = self._next_ns if time_ns is None else time_ns
        if isinstance(stamp_ns, bool) or not isinstance(stamp_ns, int) or not 0 <= stamp_ns < MAX_TIME_NS:
            raise InvalidArgument(
                f"time_ns must be a whole number of nanoseconds from 0 to {MAX_TIME_NS - 1}, got {time_ns!r:.40}",
                field="time_ns",
            )
        self._next_ns = stamp_ns + FRAME_TIME_NS
        self._do(partial(self._write, frame, stamp_ns))

    def close(self) -> None:
        """Make the file whole and give it its name; a second time nothing. Raises OSError."""
        try:
            if self._is_writable:
                self._do(self._finish)
        finally:
            self._end()

    def _do(self, task: Callable[[], None]) -> None:
        """Has the thread do a task, and waits for it. Raises what it raises."""
        done: SimpleQueue[BaseException | None] = SimpleQueue()
        self._work.put((task, done))
        if (error := done.get()) is not None:
            raise error

    def _write(self, frame: Frame, stamp_ns: int) -> None:
        with self._giving_up_on_error():
            self._writer.add(frame.arrays, frame.pose, asdict(frame.extrapolation), origin_of(frame), stamp_ns)
            self._file.flush()  # a program that is killed loses no chunk that was complete

    def _finish(self) -> None:
        if not self._is_writable:  # the frame before could not be written
            return
        with self._giving_up_on_error():
            self._writer.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            self._temporary.replace(self._path)
        self._is_writable = False

    @contextlib.contextmanager
    def _giving_up_on_error(self) -> Iterator[None]:
        """Leaves no file where writing fails."""
        try:
            yield
        except BaseException:
            self._is_writable = False
            with contextlib.suppress(OSError):  # on a full disk, closing fails as writing did
                self._file.close()
            self._temporary.unlink(missing_ok=True)
            raise


_Work: TypeAlias = tuple[Callable[[], None], "SimpleQueue[BaseException | None]"]  # and where its outcome goes


def _do_all(work: SimpleQueue[_Work | None]) -> None:
    while (item := work.get()) is not None:
        task, done = item
        try:
            task()
        except BaseException as error:
            done.put(error)
        else:
            done.put(None)
        del item, task, done  # else the recording would not end while the next one is waited for

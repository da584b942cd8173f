"""Recordings at all front doors: frames of a sweep as the probe takes them, stored before they are acknowledged.

    door ── IncomingFrame ──► RecordingStream.put ── a few at a time ──► a block of the recording ──► acknowledgement

A door reads its own messages into `IncomingFrame`; everything behind is the same. Blocks are written one after another,
each with all frames that have come meanwhile, so that a storage far away keeps up with the probe.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

from ultragray.contract import described
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.geometry.probe import FloatArray
from ultragray_service.access.audit import account
from ultragray_service.access.limits import Slots
from ultragray_service.access.owners import Claim, Owners
from ultragray_service.core.threads import to_its_end
from ultragray_service.core.uploads import DATASET_CHECK_TIMEOUT_S, Means
from ultragray_service.errors import Refusal
from ultragray_workers.datasets.intake import IncomingDataset, take_in
from ultragray_workers.datasets.recording import RecordedFrame, RecordingSettings, RecordingState, RecordingWriter
from ultragray_workers.datasets.store import DatasetRecord, DatasetStore, check_dataset_name
from ultragray_workers.errors import DatasetExists, DatasetInUse, Draining, RecordingTaken
from ultragray_workers.jobs.owners import Kind

MAX_STREAMS = 16  # of recordings, at a service
MAX_WAITING_BYTES = 32 * 2**20  # of frames that are not stored yet; then the sender waits
MAX_NUMBER = 2**53 - 1  # that JSON holds exactly


@dataclass(frozen=True, eq=False, kw_only=True)
class IncomingFrame:
    """A real frame as a client sent it."""

    pose: FloatArray  # [4, 4] mm, exact
    image: bytes  # grey pixels of 8 bits, row by row, or a PNG file
    number: int | None = None  # in the sender's count; None: the next
    time_s: float | None = None


@dataclass(frozen=True)
class RefusedFrame:
    """A frame that cannot be recorded, and why."""

    number: int | None  # as its sender told it
    error: InvalidArgument


@dataclass(frozen=True)
class RecordingView(RecordingState):
    """How far a recording is. What it tells is stored."""

    owner: str | None = described("Who records it; null: nobody who is known.", None)
    private: bool = described("Whether others may not see it.", False)


class RecordingStream:
    """The one who records at the moment. Belongs to one event loop; `changed` is set when more is stored."""

    def __init__(self, writer: RecordingWriter, max_bytes: int, owners: Owners) -> None:
        self._writer, self._max_bytes, self._owners = writer, max_bytes, owners
        self._next_number = writer.state.next_number
        self._waiting: list[RecordedFrame] = []
        self._waiting_bytes = 0
        self._storing: asyncio.Task[None] | None = None
        self._failure: Exception | None = None
        self.changed = asyncio.Event()

    @property
    def state(self) -> RecordingView:
        return _viewed(self._owners, self._writer.state)

    async def put(self, frame: IncomingFrame) -> None:
        """Takes a frame; one that is sent again though it is stored is left out.

        Raises InvalidArgument and its kinds for a frame that cannot be recorded, such as another one of a number that
        was passed already, after which others can, and what storing those before it has raised.
        """
        self.require_stored()
        number = self._next_number if frame.number is None else frame.number
        if not 0 <= number <= MAX_NUMBER:
            raise InvalidArgument(f"number must be from 0 to {MAX_NUMBER}, got {number}", field="number")
        pixels = await asyncio.to_thread(self._writer.state.settings.pixels, frame.image)
        recorded = RecordedFrame(number, frame.time_s, frame.pose, pixels)
        if number < self._next_number:
            await self._require_sent_again(recorded)
            return
        self._waiting.append(recorded)
        self._waiting_bytes += pixels.nbytes
        self._next_number = number + 1
        if self._storing is None or self._storing.done():
            self._storing = asyncio.create_task(self._store())
        if self._waiting_bytes > MAX_WAITING_BYTES:
            await self.stored()

    async def stored(self) -> RecordingView:
        """Waits until all that came is stored. Raises what storing it raises."""
        if self._storing is not None:
            await asyncio.wait({self._storing})
        self.require_stored()
        return self.state

    def require_stored(self) -> None:
        """Raises what storing a frame has raised, whatever it is."""
        if self._failure is not None:
            raise self._failure

    async def _require_sent_again(self, frame: RecordedFrame) -> None:
        await self.stored()
        if not await asyncio.to_thread(self._writer.has, frame):
            raise InvalidArgument(
                f"number must be at least {self._next_number}, the next of this recording, got {frame.number} with a "
                "frame that is not stored under it: a sweep goes on counting where the one before ended, or leaves "
                "number out",
                field="number",
            )

    async def _store(self) -> None:
        try:
            while self._waiting:
                frames, self._waiting, self._waiting_bytes = self._waiting, [], 0
                await asyncio.to_thread(self._writer.append, frames, self._max_bytes)
                self.changed.set()
        except Exception as error:  # the client, who waits for the next answer, is told
            self._failure = error
            self.changed.set()


@dataclass(frozen=True)
class RecordingAnswer:
    """What a client that records is told: first of all, whenever more is stored, and of a frame that is refused."""

    recording: RecordingView
    refused_number: int | None = described("Of a frame that cannot be recorded; null: it told none.", None)
    error: Refusal | None = described("Why it cannot.", None)


async def record(
    stream: RecordingStream,
    receive: Callable[[], Awaitable[IncomingFrame | RefusedFrame | None]],  # None: the client has sent all
    send: Callable[[RecordingAnswer], Awaitable[None]],
    draining: asyncio.Event,
) -> None:
    """Records what a client sends, to its end. Raises what storing raises, and Draining where the service stops."""
    sending = asyncio.Lock()

    async def answer(refused: RefusedFrame | None = None) -> None:
        number, error = (None, None) if refused is None else (refused.number, Refusal.of(refused.error))
        async with sending:
            await send(RecordingAnswer(stream.state, number, error))

    async def take() -> None:
        while (frame := await receive()) is not None:
            if isinstance(frame, RefusedFrame):
                await answer(frame)
                continue
            try:
                await stream.put(frame)
            except InvalidArgument as error:
                await answer(RefusedFrame(frame.number, error))

    async def tell() -> None:
        while True:
            stream.require_stored()
            await answer()
            await stream.changed.wait()
            stream.changed.clear()

    taking, telling, stopping = map(asyncio.ensure_future, (take(), tell(), draining.wait()))
    tasks: set[asyncio.Future[Any]] = {taking, telling, stopping}
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        async with sending:  # an answer that is half written is written to its end
            if stopping.done():
                raise Draining("the service is stopping; go on when it is back")
            (telling if telling.done() else taking).result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    await stream.stored()
    await answer()


class OpenRecordings:
    """The recordings that are no data sets yet, and who records at this service."""

    def __init__(self, store: DatasetStore, means: Means) -> None:
        self._store, self._recordings, self._means = store, store.recordings, means
        self._slots = Slots(MAX_STREAMS, "recordings")
        self._at_work: set[str] = set()  # names: a stream, or what ends the recording

    async def begin(self, name: str, settings: RecordingSettings, *, private: bool) -> RecordingView:
        """Begins a recording; of one that was begun with these settings, how far it is.

        Raises InvalidArgument, DatasetExists, PermissionDenied, LimitReached, Draining.
        """
        check_dataset_name(name)
        account().target = name
        self._require_staying()
        if not await asyncio.to_thread(self._recordings.is_open, name):
            await self._begin_new(name, settings, private=private)
        self._means.owners.require_change(Kind.DATASET, name)
        await asyncio.to_thread(self._recordings.begin, name, settings)
        return await self.get(name)

    async def get(self, name: str) -> RecordingView:
        """Raises DatasetNotFound."""
        await asyncio.to_thread(self._store.require, name)
        return _viewed(self._means.owners, await asyncio.to_thread(self._recordings.state, name))

    @asynccontextmanager
    async def stream(self, name: str) -> AsyncIterator[RecordingStream]:
        """Records during the body; what came is stored at its end, whatever ends it.

        Raises DatasetNotFound, RecordingTaken where somebody records there already, QueueFull, LimitReached, Draining.
        """
        means = self._means
        async with self._alone(name), means.quotas.room(means.jobs, means.settings.max_dataset_bytes) as left_bytes:
            writer = await asyncio.to_thread(self._recordings.writer, name)
            stream = RecordingStream(writer, left_bytes + writer.state.bytes, means.owners)
            try:
                yield stream
            finally:
                await asyncio.shield(stream.stored())

    async def finish(self, name: str) -> DatasetRecord:
        """Makes a recording a data set, after the check of an upload; of one that is one already, the data set, for a
        client who did not hear the answer. Raises DatasetNotFound, DatasetInvalid.
        """
        if not await asyncio.to_thread(self._recordings.is_open, name):
            account().target = name
            record = await asyncio.to_thread(self._store.get, name)
            self._means.owners.require_change(Kind.DATASET, name)
            return record
        async with self._alone(name):
            if await asyncio.to_thread(self._store.manifest, name) is None:  # else a service died right after it
                await self._take_in(name)
            await asyncio.to_thread(self._recordings.delete, name)
            return await asyncio.to_thread(self._store.get, name)

    async def delete(self, name: str) -> None:
        """Raises DatasetNotFound, and DatasetInUse where a live job follows it."""
        means = self._means
        async with self._alone(name):
            if (user := await asyncio.to_thread(means.jobs.uses_dataset, name)) is not None:
                raise DatasetInUse(f"the recording {name!r} is needed by {user}", field="dataset")
            async with means.owners.removing(Kind.DATASET, name):
                await asyncio.to_thread(self._recordings.delete, name)

    async def _begin_new(self, name: str, settings: RecordingSettings, *, private: bool) -> None:
        means, store = self._means, self._store

        def is_there(claim: str | None) -> bool:
            return (claim is not None and store.storage.is_claimed(claim)) or store.is_taken(name)

        async with means.quotas.room(means.jobs, means.settings.max_dataset_bytes):
            claim = Claim(means.owners, Kind.DATASET, name, f"recording-{name}", private=private)
            async with claim.held():
                is_ours = await claim.take(lambda other: asyncio.to_thread(is_there, other))
                if not is_ours or await asyncio.to_thread(store.manifest, name) is not None:
                    raise DatasetExists(f"there is already a dataset {name!r}: choose another name", field="dataset")
                await asyncio.to_thread(self._recordings.begin, name, settings)
                claim.is_made = True
                await claim.spread()

    async def _take_in(self, name: str) -> None:
        means, max_bytes = self._means, self._means.settings.max_dataset_bytes
        incoming = await asyncio.to_thread(IncomingDataset, self._store, max_bytes)
        arguments = {
            "folder": str(incoming.folder),
            "name": name,
            "options": {},
            "max_bytes": max_bytes,
            "recorded": self._store.storage.location,
        }
        try:
            await means.checks.run(
                take_in,
                arguments,
                what="checking the recording",
                timeout_s=DATASET_CHECK_TIMEOUT_S,
                killed=DatasetInvalid,
            )
            await to_its_end(partial(incoming.accept, name))
        finally:
            await asyncio.shield(asyncio.to_thread(incoming.discard))

    @asynccontextmanager
    async def _alone(self, name: str) -> AsyncIterator[None]:
        """Nobody else is at the recording at this service. Another service is refused at its first block."""
        account().target = name
        self._require_staying()
        await self.get(name)
        self._means.owners.require_change(Kind.DATASET, name)
        if name in self._at_work:
            raise RecordingTaken(f"somebody records {name!r} already: one may at a time", field="dataset")
        with self._slots.one():
            self._at_work.add(name)
            try:
                yield
            finally:
                self._at_work.discard(name)

    def _require_staying(self) -> None:
        if self._means.draining.is_set():
            raise Draining("the service is stopping; send it again")


def _viewed(owners: Owners, state: RecordingState) -> RecordingView:
    ownership = owners.known(Kind.DATASET, state.name)
    return RecordingView(**vars(state), owner=ownership.owner, private=ownership.private)

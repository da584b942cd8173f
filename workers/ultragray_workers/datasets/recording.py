"""Recordings: data sets that are still open, to which frames are added as a probe takes them. Free of torch.

recordings/NAME.json             what is recorded; there is a recording as long as there is this
recording-blocks/ID/00000007     some frames that came one after another; a block is there whole, and never changes

A frame that was acknowledged is on the disk, or in the bucket. Blocks are numbered, and each is written on the
condition that none has its number: of two writers the second is refused at its first block. Of a file system that lost
power the last block may be cut off; the next writer removes it. `datasets.intake` makes the frames a data set.
"""

from __future__ import annotations

import json
import math
import secrets
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timezone
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ultragray.contract import Contract, described, from_dict, to_dict
from ultragray.errors import InvalidArgument, InvalidImageSize
from ultragray.files import require_version
from ultragray.geometry.image_size import MAX_IMAGE_SIDE, check_image_size
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.learn.localization.pixels import read_grey, read_png
from ultragray.learn.sweep import ByteArray, Dataset, Sweep, split_sequence
from ultragray_workers.errors import DatasetExists, DatasetNotFound, RecordingTaken, UploadTooLarge
from ultragray_workers.storage.storage import NotThere, Storage

RECORDINGS, BLOCKS = "recordings", "recording-blocks"  # prefixes of keys
FORMAT_VERSION = 1
PAUSE_S = 2.0  # between frames; more is told as a pause
_PNG = b"\x89PNG"
_LENGTH_BYTES = 4  # before the JSON of a block, its length, the low byte first


@dataclass(frozen=True)
class RecordingSettings(Contract):
    """What all frames of a recording have in common. Raises InvalidArgument and its kinds."""

    probe: Probe = described("The probe that takes the frames.")
    image_height: int = described("Rows of a frame, along depth.", low=1, high=MAX_IMAGE_SIDE, error=InvalidImageSize)
    image_width: int = described(
        "Columns of a frame, across scan lines.", low=1, high=MAX_IMAGE_SIDE, error=InvalidImageSize
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_image_size(self.image_height, self.image_width)

    def pixels(self, image: bytes) -> ByteArray:  # [H, W]
        """The pixels of a frame as it came: grey ones of 8 bits, row by row, or a PNG file.

        Raises InvalidArgument for what is neither and for a frame in which every pixel is the same, InvalidImageSize.
        """
        height, width = self.image_height, self.image_width
        is_raw = len(image) == height * width
        if not is_raw and not image.startswith(_PNG):
            raise InvalidArgument(
                f"image must be a PNG file, or {height}x{width} = {height * width} bytes of grey pixels, as the "
                f"recording was begun, got {len(image)} bytes that are neither",
                field="image",
            )
        pixels = read_grey(image, height, width) if is_raw else read_png(image)
        if pixels.shape != (height, width):
            raise InvalidImageSize(
                f"image must be {height}x{width}, as the recording was begun, got {pixels.shape[0]}x{pixels.shape[1]}",
                field="image",
            )
        if pixels.min() == pixels.max():
            raise InvalidArgument(f"image is constant: every pixel is {pixels[0, 0]}", field="image")
        return pixels


@dataclass(frozen=True)
class RecordingState(Contract):
    """How far a recording is. What it tells is stored."""

    name: str = described("Also of the dataset that it becomes.")
    settings: RecordingSettings = described("As it was begun.")
    frames: int = described("That are stored.")
    next_number: int = described("Least number that the next frame may have: those before it were stored, or are lost.")
    bytes: int = described("Of its blocks.")
    created_at: str = described("ISO 8601, UTC.")


@dataclass(frozen=True, eq=False)
class RecordedFrame:
    """A frame with its number in the sender's count, and when it was taken, s (None: not known)."""

    number: int
    time_s: float | None
    pose: FloatArray  # [4, 4] mm, probe→tracker
    pixels: ByteArray  # [H, W]


@dataclass(frozen=True)
class _Header:
    id: str
    created_at: str
    settings: RecordingSettings

    @property
    def blocks(self) -> str:
        return f"{BLOCKS}/{self.id}"


class Recordings:
    """The recordings of a storage. Methods block, and raise StorageUnavailable."""

    def __init__(self, storage: Storage) -> None:
        self.storage = storage

    def is_open(self, name: str) -> bool:
        return self.storage.entry(_key(name)) is not None

    def names(self) -> list[str]:
        return sorted(Path(entry.key).stem for entry in self.storage.entries_in(RECORDINGS))

    def begin(self, name: str, settings: RecordingSettings) -> None:
        """Begins a recording; nothing where there is one with these settings. Raises DatasetExists for others."""
        header = _Header(secrets.token_hex(16), datetime.now(timezone.utc).isoformat(timespec="seconds"), settings)
        document = {"format_version": FORMAT_VERSION, **asdict(header), "settings": to_dict(settings)}
        if self.storage.write(_key(name), (json.dumps(document, indent=1) + "\n").encode(), if_absent=True):
            return
        if self._header(name).settings != settings:
            raise DatasetExists(
                f"there is already a recording {name!r} of another probe or image size: finish or delete it first, or "
                "choose another name",
                field="dataset",
            )

    def settings(self, name: str) -> RecordingSettings:
        """Raises DatasetNotFound."""
        return self._header(name).settings

    def writer(self, name: str) -> RecordingWriter:
        """Raises DatasetNotFound."""
        return RecordingWriter(self.storage, name, self._header(name))

    def state(self, name: str) -> RecordingState:
        """Raises DatasetNotFound."""
        return self.writer(name).state

    def frames(self, name: str, after: int = 0) -> Iterator[list[RecordedFrame]]:
        """The frames of each block, from a block on, as far as they are stored. Raises DatasetNotFound."""
        header = self._header(name)
        while True:
            try:
                data = self.storage.read(_block_key(header, after))
            except NotThere:
                return
            if (frames := _unpack(data, header.settings)) is None:  # cut off: the next writer removes it
                return
            yield frames
            after += 1

    def delete(self, name: str) -> None:
        """Raises DatasetNotFound."""
        header = self._header(name)
        self.storage.delete(_key(name))
        self.storage.delete_all(header.blocks)

    def ids(self) -> set[str]:
        return {self._header(name).id for name in self.names()}

    def _header(self, name: str) -> _Header:
        try:
            document = json.loads(self.storage.read(_key(name)))
            require_version(document["format_version"], FORMAT_VERSION)
            settings = from_dict(RecordingSettings, document["settings"])
        except NotThere:
            raise DatasetNotFound(f"there is no open recording {name[:128]!r}", field="dataset") from None
        return _Header(document["id"], document["created_at"], settings)


class RecordingWriter:
    """Adds frames to a recording. One at a time; what it has not stored it does not tell."""

    def __init__(self, storage: Storage, name: str, header: _Header) -> None:
        """Finds where the recording ends, and removes a last block that was cut off."""
        self._storage, self._header, self._token = storage, header, secrets.token_hex(8)
        sizes = {entry.key: entry.bytes for entry in storage.entries_in(header.blocks)}
        frames = next_number = 0
        while sizes:
            last = max(sizes)
            data = storage.read(last)
            if (block_frames := _unpack(data, header.settings)) is not None:
                frames, next_number = _document(data)["before"] + len(block_frames), block_frames[-1].number + 1
                break
            storage.delete(last)
            del sizes[last]
        self._count = len(sizes)
        self._first_numbers: dict[int, int] = {}  # of blocks that were looked into
        self._looked_into: tuple[int, list[RecordedFrame]] | None = None  # the last of them, whole
        self.state = RecordingState(name, header.settings, frames, next_number, sum(sizes.values()), header.created_at)

    def has(self, frame: RecordedFrame) -> bool:
        """Whether this very frame is stored: its number, with its pose and pixels.

        Numbers rise from block to block, and within one.
        """
        block = bisect_right(range(self._count), frame.number, key=self._first_number) - 1
        if block < 0:
            return False
        if self._looked_into is None or self._looked_into[0] != block:
            frames = _unpack(self._storage.read(_block_key(self._header, block)), self._header.settings)
            self._looked_into = block, frames or []
        return any(
            one.number == frame.number
            and np.array_equal(one.pose, frame.pose)
            and np.array_equal(one.pixels, frame.pixels)
            for one in self._looked_into[1]
        )

    def append(self, frames: Sequence[RecordedFrame], max_bytes: int | None = None) -> RecordingState:
        """Stores frames, at least one, in one block. Their numbers rise, from `next_number` of the state on.

        Raises RecordingTaken where somebody else has added to the recording, UploadTooLarge beyond `max_bytes`.
        """
        state = self.state
        data = _pack(self._token, state.frames, frames)
        if max_bytes is not None and state.bytes + len(data) > max_bytes:
            raise UploadTooLarge(f"a recording may have at most {max_bytes} bytes", field="dataset")
        if not self._storage.write(_block_key(self._header, self._count), data, if_absent=True):
            raise RecordingTaken(f"somebody else records {state.name!r} as well: one may at a time", field="dataset")
        self._count += 1
        self.state = replace(
            state,
            frames=state.frames + len(frames),
            next_number=frames[-1].number + 1,
            bytes=state.bytes + len(data),
        )
        return self.state

    def _first_number(self, block: int) -> int:
        if block not in self._first_numbers:
            document = _document(self._storage.read(_block_key(self._header, block)))
            self._first_numbers[block] = document["frames"][0]["number"]
        return self._first_numbers[block]


def recorded_dataset(recordings: Recordings, name: str) -> tuple[Dataset, tuple[str, ...]]:
    """A recording as the data set that it becomes, every fifth frame held out, and what a person is to be told of it.

    It has the times of the frames where each has one. Raises DatasetNotFound, DatasetInvalid where there are too few
    frames.
    """
    settings = recordings.settings(name)
    frames = [frame for block in recordings.frames(name) for frame in block]
    height, width = settings.image_height, settings.image_width
    times = _times(frames)
    sweep = Sweep(
        np.stack([frame.pixels for frame in frames]) if frames else np.zeros((0, height, width), np.uint8),
        np.stack([frame.pose for frame in frames]) if frames else np.zeros((0, 4, 4)),
        settings.probe,
        np.arange(len(frames)),
        name,
        times_s=np.array(times) if len(times) == len(frames) else None,
    )
    train, val = split_sequence(sweep, len(sweep), None, None)
    return Dataset(name, train, val), tuple(_remarks(frames))


def _times(frames: Sequence[RecordedFrame]) -> list[float]:
    """The times of the frames that have one, s; NaN and infinity are none."""
    return [frame.time_s for frame in frames if frame.time_s is not None and math.isfinite(frame.time_s)]


def _remarks(frames: Sequence[RecordedFrame]) -> Iterator[str]:
    numbers = [-1, *(frame.number for frame in frames)]  # a sender counts from 0
    if gaps := [(before, after) for before, after in pairwise(numbers) if after - before > 1]:
        missing = sum(after - before - 1 for before, after in gaps)
        before, after = gaps[0]
        place = f"before frame {after}" if before < 0 else f"after frame {before}"
        places = place if len(gaps) == 1 else f"in {len(gaps):,} places, the first {place}"
        are_missing = "1 frame is missing" if missing == 1 else f"{missing:,} frames are missing"
        yield f"{are_missing}, lost on the way or refused, {places}"
    if pauses := [after - before for before, after in pairwise(_times(frames)) if after - before > PAUSE_S]:
        paused = "once, for" if len(pauses) == 1 else f"{len(pauses):,} times, at most for"
        yield f"the recording paused {paused} {max(pauses):.0f} s"


def _key(name: str) -> str:
    return f"{RECORDINGS}/{name}.json"


def _block_key(header: _Header, number: int) -> str:
    return f"{header.blocks}/{number:08d}"


def _pack(writer: str, before: int, frames: Sequence[RecordedFrame]) -> bytes:
    """A block: the length of its JSON, the JSON, the pixels of its frames."""
    entries = [{"number": one.number, "time_s": one.time_s, "pose": one.pose.ravel().tolist()} for one in frames]
    head = json.dumps({"writer": writer, "before": before, "frames": entries}).encode()
    return len(head).to_bytes(_LENGTH_BYTES, "little") + head + b"".join(one.pixels.tobytes() for one in frames)


def _document(data: bytes) -> dict[str, Any]:
    """The JSON of a block. Raises ValueError where it is cut off."""
    end = _LENGTH_BYTES + int.from_bytes(data[:_LENGTH_BYTES], "little")
    document: dict[str, Any] = json.loads(data[_LENGTH_BYTES:end])
    return document


def _unpack(data: bytes, settings: RecordingSettings) -> list[RecordedFrame] | None:
    """The frames of a block; None where it is cut off."""
    try:
        entries = _document(data)["frames"]
    except ValueError:
        return None
    shape = len(entries), settings.image_height, settings.image_width
    start = _LENGTH_BYTES + int.from_bytes(data[:_LENGTH_BYTES], "little")
    if len(data) - start != shape[0] * shape[1] * shape[2]:
        return None
    pixels = np.frombuffer(data, np.uint8, offset=start).reshape(shape)
    return [
        RecordedFrame(one["number"], one["time_s"], np.array(one["pose"]).reshape(4, 4), image)
        for one, image in zip(entries, pixels, strict=True)
    ]

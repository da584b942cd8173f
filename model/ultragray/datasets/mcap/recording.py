"""A recorded sweep out of an MCAP file: one topic of images, the poses at their times, and their geometry.

The file is read three times, a message at a time: for poses and geometry, for the times of the images that were chosen,
and for the pixels of those that have a pose.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ultragray.datasets.images import MAX_PIXEL_BYTES
from ultragray.datasets.mcap.geometry import BESIDE, ImageGeometry, geometry_beside, read_geometry
from ultragray.datasets.mcap.images import KINDS, grey_image
from ultragray.datasets.mcap.messages import NS_PER_S, MessageFile, StoredMessage, time_of
from ultragray.datasets.mcap.poses import MAX_GAP_NS, TF, TrackedPoses, Way
from ultragray.datasets.splits import parse_frame_ranges
from ultragray.datasets.sweep import ByteArray, IntArray, Sweep
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.interchange.ros_messages import TEXT

PREFERRED_IMAGES, PREFERRED_POSES, GEOMETRY = "/bmode", "/probe_pose", "/geometry"  # ends of the node's topics


def read_mcap_sweep(
    path: Path,
    *,
    frames: str | None = None,
    crop: str | None = None,
    transform: str | None = None,
    image_topic: str | None = None,
    pose_topic: str | None = None,
) -> tuple[Sweep, int]:
    """The images of one topic that have a pose, and how many images it has.

    `frames` (ranges, `parse_frame_ranges`) chooses among them; `crop` is "columns,rows" of images of a linear probe.
    Of several topics, that of images which ends in /bmode and that of poses which ends in /probe_pose are taken unless
    `image_topic` and `pose_topic` name others; `/tf` stands for the transforms of tf, of which `transform`, such as
    probeTobase, names two frames. A pose lies between those before and after the image (position linear, orientation
    by slerp), at most 0.2 s apart; the notes say how many images have none. Raises DatasetInvalid, naming the file, the
    frame and the reason; InvalidArgument for options that do not fit.
    """
    file = MessageFile(path)
    contents = _Contents(file)
    topic = _chosen(path, "image_topic", image_topic, sorted(contents.image_counts), PREFERRED_IMAGES, contents)
    source = _chosen(path, "pose_topic", pose_topic, contents.poses.topics, PREFERRED_POSES, contents)
    count = contents.image_counts[topic]
    numbers = range(count) if frames is None else parse_frame_ranges(frames, count, option="frames")
    times = _ImageTimes(file, topic, numbers)
    way = contents.poses.way(source, times.frame_id, transform)
    poses, known = way.at(times.times_ns)
    if not known.any():
        raise DatasetInvalid(f"{path}: none of {len(known)} images has a pose: {_why_none(times.times_ns, way)}")
    with_pose = times.numbers[known]
    geometry = contents.geometry_of(topic, times.log_times_ns[known], with_pose)
    images = _read_images(file, topic, with_pose)
    notes = _notes(file, way, source == TF and transform is None, times.numbers[~known])
    return geometry.sweep(images, poses[known], with_pose, path, notes, crop), count


class _Contents:
    """The poses, the geometries and the topics of a file."""

    def __init__(self, file: MessageFile) -> None:
        self.poses = TrackedPoses(file.path)
        self.image_counts: Counter[str] = Counter()
        self.kinds: dict[str, str] = {}
        self._geometries: dict[str, list[tuple[int, str]]] = {}  # time of writing and text, by topic
        self._path = file.path
        for message in file.messages():
            self.kinds[message.topic] = message.kind
            if message.kind in KINDS:
                self.image_counts[message.topic] += 1
            elif message.kind == TEXT and message.topic.endswith(GEOMETRY):
                self._geometries.setdefault(message.topic, []).append((message.log_time_ns, message.decode().data))
            else:
                self.poses.take(message)

    def geometry_of(self, topic: str, log_times_ns: IntArray, numbers: IntArray) -> ImageGeometry:
        """The one geometry of images. Raises DatasetInvalid where there is none, or it changes among them."""
        if (given := geometry_beside(self._path)) is not None:
            return given
        near = [told for name, told in self._geometries.items() if topic.startswith(name.removesuffix(GEOMETRY[1:]))]
        if len(near) != 1:
            raise DatasetInvalid(
                f"{self._path}: it does not say which probe its images are of, on a topic beside {topic} that ends in "
                f"{GEOMETRY}: say it in {self._path.stem}{BESIDE} beside the file, such as "
                '{"probe": {"kind": "linear", "width_mm": 40, "near_mm": 0, "far_mm": 50}}'
            )
        told = sorted(near[0])
        times = [time_ns for time_ns, _ in told]
        texts = [told[max(0, bisect_right(times, int(time_ns)) - 1)][1] for time_ns in log_times_ns]
        known = {text: read_geometry(text, str(self._path)) for text in dict.fromkeys(texts)}
        for number, text in zip(numbers, texts, strict=True):
            if known[text] != known[texts[0]]:
                raise DatasetInvalid(
                    f"{self._path}: frame {number}: its geometry is another one than that of frame {numbers[0]}: "
                    f"choose those of one geometry with frames, such as {numbers[0]}:{number}"
                )
        return known[texts[0]]


def _chosen(path: Path, option: str, asked: str | None, topics: list[str], preferred: str, contents: _Contents) -> str:
    """The topic that was asked for; else the only one, or the only one that ends as the node's do."""
    noun = option.removesuffix("_topic") + "s"
    listed = ", ".join(topics) or ", ".join(f"{topic} ({kind})" for topic, kind in sorted(contents.kinds.items()))
    if asked is not None:
        if asked not in topics:
            raise InvalidArgument(f"{option} must be one of {listed or 'no topics'}, got {asked[:80]!r}", field=option)
        return asked
    found = topics if len(topics) == 1 else [topic for topic in topics if topic.endswith(preferred)]
    if len(found) != 1:
        needed = f"choose one with {option}" if topics else f"a sweep needs a topic of {noun}"
        raise DatasetInvalid(f"{path}: {needed}: there are {listed or 'no messages'}")
    return found[0]


def _chosen_images(file: MessageFile, topic: str, numbers: Any) -> Iterator[tuple[int, StoredMessage]]:
    """The images with these numbers, counted in their topic."""
    wanted = {int(number) for number in numbers}
    number = 0
    for message in file.messages():
        if message.topic == topic:
            if number in wanted:
                yield number, message
            number += 1


class _ImageTimes:
    """The times of images, [F] each, and the frame that they are in."""

    def __init__(self, file: MessageFile, topic: str, numbers: Any) -> None:
        found, self.frame_id = [], ""
        for number, message in _chosen_images(file, topic, numbers):
            header = message.decode().header
            self.frame_id = self.frame_id or header.frame_id.lstrip("/")
            found.append((number, time_of(header, message.log_time_ns), message.log_time_ns))
        self.numbers, self.times_ns, self.log_times_ns = np.array(found, np.int64).reshape(-1, 3).T


def _read_images(file: MessageFile, topic: str, numbers: IntArray) -> ByteArray:  # [F, rows, columns]
    """Raises DatasetInvalid, naming the frame, where the size changes, or all of them are too large."""
    images: ByteArray | None = None
    for place, (number, message) in enumerate(_chosen_images(file, topic, numbers)):
        image = grey_image(message.decode(), message.kind, f"{file.path}: frame {number}")
        if images is None:
            if image.size * len(numbers) > MAX_PIXEL_BYTES:
                raise DatasetInvalid(
                    f"{file.path}: its frames must have at most {MAX_PIXEL_BYTES:,} pixels, {len(numbers)} of "
                    f"{image.shape[1]} x {image.shape[0]} have more: choose some with frames"
                )
            images = np.empty((len(numbers), *image.shape), np.uint8)
        if image.shape != images.shape[1:]:
            first = numbers[0]
            raise DatasetInvalid(
                f"{file.path}: frame {number} has {image.shape[1]} x {image.shape[0]} pixels, frame {first} "
                f"{images.shape[2]} x {images.shape[1]}: choose those of one size with frames, such as {first}:{number}"
            )
        images[place] = image
    assert images is not None  # there are numbers
    return images


def _why_none(times_ns: IntArray, way: Way) -> str:
    begin, end = (time_ns / NS_PER_S for time_ns in way.span_ns)
    first, last = times_ns[0] / NS_PER_S, times_ns[-1] / NS_PER_S
    if last < begin or end < first:
        return (
            f"images are stamped {first:.3f} to {last:.3f} s, poses of {way.name} {begin:.3f} to {end:.3f} s: were the "
            "clocks other ones?"
        )
    return f"those of {way.name} before and after an image must be at most {MAX_GAP_NS / 1e6:g} ms apart"


def _notes(file: MessageFile, way: Way, is_way_guessed: bool, left_out: IntArray) -> tuple[str, ...]:
    notes = []
    if file.broke_off:
        notes.append("the file breaks off: its recording was not finished; it was read as far as it goes")
    if is_way_guessed:
        notes.append(f"poses are taken from tf: {way.name}")
    if way.lost:
        notes.append(f"{way.lost} poses of {way.name} are none, such as of a probe that was lost, and were passed over")
    if len(left_out):
        listed = ", ".join(map(str, left_out[:10])) + (", …" if len(left_out) > 10 else "")
        notes.append(
            f"images without poses at most {MAX_GAP_NS / 1e6:g} ms apart around them were left out: {listed} "
            f"({len(left_out)} in all)"
        )
    return tuple(notes)

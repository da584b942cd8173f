"""MCAP files with images and poses of ROS 2, as `ros2 bag record -s mcap` writes them. The extra `mcap`.

First the geometry of the image, as the topic `geometry` of the ROS 2 node says it, or a file beside the recording:
`{"probe": {"kind": "linear", …}}`, with a `picture` where the pixels are not the probe's own scan lines. Then the poses
of the probe, then the sweep of both.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from ultragray.datasets.clocks import (
    MAX_GAP_NS,
    NS_PER_MS,
    NS_PER_S,
    BoolArray,
    PoseTrack,
    delay_note,
    goes_to_and_fro_mm,
    parse_delay_ns,
)
from ultragray.datasets.fan import TransformName, find_path
from ultragray.datasets.image_geometry import SAME, ImageGeometry, read_geometry
from ultragray.datasets.images import MAX_PIXEL_BYTES, eight_bits
from ultragray.datasets.mcap_messages import KINDS, MessageFile, StoredMessage, grey_image, time_of
from ultragray.errors import DatasetInvalid, InvalidArgument, InvalidPose
from ultragray.exchange.ros_fields import TRANSFORM, TRANSFORMS, pose_of_parts
from ultragray.exchange.ros_messages import POSE, TEXT
from ultragray.geometry.probe import FloatArray
from ultragray.learn.sweep import (
    ByteArray,
    Chain,
    IntArray,
    Link,
    Sweep,
    frame_list,
    parse_frame_ranges,
)

MAX_GEOMETRY_BYTES = 1 << 20


def geometry_beside(path: Path) -> ImageGeometry | None:
    """The geometry in the file `STEM.geometry.json` beside a recording; None where there is none."""
    beside = path.with_name(f"{path.stem}{BESIDE}")
    if not beside.is_file():
        return None
    if beside.stat().st_size > MAX_GEOMETRY_BYTES:
        raise DatasetInvalid(f"{beside}: too large for a geometry: over {MAX_GEOMETRY_BYTES >> 20} MiB")
    return read_geometry(beside.read_bytes(), str(beside))


BESIDE = ".geometry.json"


# Poses at the times of images: from the tracked poses before and after.


TF, STATIC = "/tf", "/tf_static"
LONGEST_LINK_MM = 5_000.0  # between two frames that do not move against each other
SLOW_PATH_NS = 50_000_000  # by which images may be written later after their stamps than poses
# Stamp and time of writing in ns, whether there was a stamp, position in metres, orientation.
_Stamped: TypeAlias = tuple[int, int, bool, Any, Any]


@dataclass(frozen=True)
class Way:
    """Poses over time, step by step from the probe's frame to the one that they are in."""

    name: str  # the topic, or the frames of tf, such as probeTobase
    steps: tuple[tuple[PoseTrack, bool], ...]  # True: inverted
    links: tuple[Link, ...]
    left_out: tuple[str, ...]  # other transforms
    notes: tuple[str, ...]
    written_ns: int  # how long after their stamps poses were written, usually

    def at(self, times_ns: IntArray) -> tuple[FloatArray, BoolArray]:  # [F] -> [F, 4, 4], [F]
        """The pose at each time, and whether it is known."""
        poses, known = np.tile(np.eye(4), (len(times_ns), 1, 1)), np.ones(len(times_ns), bool)
        for track, is_inverted in self.steps:
            found, is_known = track.at(times_ns)
            poses = (np.linalg.inv(found) if is_inverted else found) @ poses
            known &= is_known
        return poses, known

    @property
    def span_ns(self) -> tuple[int, int]:
        """The times between which there are poses."""
        moving = [track.times_ns for track, _ in self.steps if len(track.times_ns)]
        return max(int(times[0]) for times in moving), min(int(times[-1]) for times in moving)


class TrackedPoses:
    """The poses of a file by topic, and the transforms of tf by their frames."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._poses: dict[str, list[_Stamped]] = {}
        self._frames: dict[str, Counter[str]] = {}  # that the poses of a topic are in
        self._tracked: dict[str, set[TransformName]] = {}  # what the transforms of a topic are of, by topic
        self._transforms: dict[TransformName, list[_Stamped]] = {}  # from child to parent
        self._topics_of: dict[TransformName, set[str]] = {}  # the topics of tf that tell a moving one
        self._fixed: dict[TransformName, list[_Stamped]] = {}

    @property
    def topics(self) -> list[str]:
        """Those that poses may be taken from; `/tf` stands for all transforms."""
        return sorted(self._poses) + ([TF] if self._transforms else [])

    def take(self, message: StoredMessage) -> None:
        """Keep the poses of a message; other messages are passed over. Raises DatasetInvalid where it is damaged."""
        if message.kind == POSE:
            stamped = message.decode()
            parts = stamped.pose.position, stamped.pose.orientation
            self._poses.setdefault(message.topic, []).append((*_times_of(stamped.header, message), *parts))
            self._frames.setdefault(message.topic, Counter())[stamped.header.frame_id.lstrip("/")] += 1
        elif message.kind == TRANSFORM:
            transform = message.decode()
            self._poses.setdefault(message.topic, []).append(_stamped(transform, message))
            self._tracked.setdefault(message.topic, set()).add(_name_of(transform))
        elif message.kind == TRANSFORMS:
            is_static = message.topic.endswith("_static")
            kept = self._fixed if is_static else self._transforms
            for transform in message.decode().transforms:
                kept.setdefault(_name_of(transform), []).append(_stamped(transform, message))
                if not is_static:
                    self._topics_of.setdefault(_name_of(transform), set()).add(message.topic)

    def way(self, topic: str, frame: str, transform: str | None) -> Way:
        """The poses of a topic, or of tf those between two frames that `transform` names, such as probeTobase.

        None: from `frame`, the one of the images, as far up as tf leads. Raises DatasetInvalid where there is no such
        way, its frames change or all of its poses are none, InvalidArgument for a transform of a topic and for frames
        that there are not.
        """
        if topic == TF:
            return self._way_of_transforms(frame, transform)
        if transform is not None:
            raise InvalidArgument(f"transform is for the poses of {TF}, these are of {topic}", field="transform")
        if len(tracked := self._tracked.get(topic, set())) > 1:
            names = ", ".join(sorted(map("To".join, tracked)))
            raise DatasetInvalid(
                f"{self._path}: {topic} must tell the poses of one thing, it tells those of {len(tracked)}: {names}; "
                f"record them as tf, or on topics of their own"
            )
        frames = self._frames.get(topic, Counter())
        if len(frames) > 1:
            listed = " and ".join(f"{name!r} ({count} poses)" for name, count in sorted(frames.items()))
            raise DatasetInvalid(
                f"{self._path}: the poses of {topic} must be in one frame, their frame_id is {listed}: record them on "
                "topics of their own"
            )
        track, notes = self._track(self._poses[topic], topic)
        name = next(iter(tracked), ("probe", next(iter(frames), "") or "tracker"))
        link = Link(*name, topic, self._path.name, is_tracked=True)
        return Way(topic, ((track, False),), (link,), (), notes, _written_ns(self._poses[topic]))

    def _way_of_transforms(self, frame: str, transform: str | None) -> Way:
        names = {*self._transforms, *self._fixed}
        frames = sorted({one for name in names for one in name})
        example, known = "To".join(min(names)), ", ".join(frames)
        if transform is None:
            start, goal = frame, self._root(frame)
            if goal == start:
                raise DatasetInvalid(
                    f"{self._path}: tf leads nowhere from the frame of the images, {frame!r}: say with transform "
                    f"between which frames of tf, such as {example}; there are {known}"
                )
        else:
            pairs = [(a, b) for a in frames for b in frames if a != b and f"{a}To{b}" == transform]
            if not pairs:
                raise InvalidArgument(
                    f"transform must be two frames of tf, such as {example}; there are {known}, got {transform[:80]!r}",
                    field="transform",
                )
            start, goal = pairs[0]
        way = find_path(names, start, goal)
        if way is None or all(name not in self._transforms for name, _ in way):
            raise DatasetInvalid(f"{self._path}: no tracked transforms of tf lead from {start} to {goal}")
        tracks, links = [], []
        notes: list[str] = []
        for name, is_inverted in way:
            called, is_tracked = "To".join(name), name in self._transforms
            if len(topics := self._topics_of.get(name, set())) > 1:
                raise DatasetInvalid(
                    f"{self._path}: {called} is told on {' and on '.join(sorted(topics))}: record the tf of one robot, "
                    "or give their frames names of their own"
                )
            track, found = self._track((self._transforms if is_tracked else self._fixed)[name], called)
            notes += found
            is_constant = np.ptp(track.poses, axis=0).max() < SAME
            if is_tracked and name in self._fixed:
                notes.append(f"{called} of {STATIC} is left out: {TF} tells it as well")
            if not is_tracked and not is_constant:
                notes.append(f"{called} of {STATIC} was told with other values: the last is taken for all images")
            if is_tracked and is_constant:
                notes.append(f"{called} of {TF} never changes: taken for all images")
            is_moving = is_tracked and not is_constant
            length_mm = float(np.linalg.norm(track.poses[-1, :3, 3]))
            if not is_moving and length_mm > LONGEST_LINK_MM:
                notes.append(f"{called} is {length_mm / 1000:.3g} m long: millimetres where metres are expected?")
            tracks.append((track, is_moving, is_inverted))
            ends = name[::-1] if is_inverted else name
            links.append(Link(*ends, called, TF if is_tracked else STATIC, is_inverted, is_moving))
        if not any(is_moving for _, is_moving, _ in tracks):  # a probe that stays where it is has times all the same
            tracks = [
                (track, name in self._transforms, flip) for (track, _, flip), (name, _) in zip(tracks, way, strict=True)
            ]
        steps = tuple((track if is_moving else track.fixed(), flip) for track, is_moving, flip in tracks)
        used = {name for name, _ in way}
        left_out = tuple("To".join(name) for name in sorted(names - used))
        written_ns = _written_ns([one for name in used & {*self._transforms} for one in self._transforms[name]])
        return Way(f"{start}To{goal}", steps, tuple(links), left_out, tuple(notes), written_ns)

    def _root(self, frame: str) -> str:
        """The frame that tf leads up to from this one, by the parent of each. Raises DatasetInvalid for two parents."""
        parents: dict[str, list[str]] = {}
        for child, parent in sorted({*self._transforms, *self._fixed}):
            parents.setdefault(child, []).append(parent)
        seen = {frame}
        while found := parents.get(frame):
            if len(found) > 1:
                raise DatasetInvalid(
                    f"{self._path}: the parent of {frame} in tf changes between {' and '.join(found)}: say with "
                    f"transform which poses to take, such as {frame}To{found[0]}"
                )
            if found[0] in seen:
                break
            frame = found[0]
            seen.add(frame)
        return frame

    def _track(self, stamped: Sequence[_Stamped], name: str) -> tuple[PoseTrack, tuple[str, ...]]:
        """The poses over time, and what is to be told of them."""
        found: dict[int, FloatArray] = {}
        problems: list[str] = []
        twice = back = 0
        latest = stamped[0][0]
        for time_ns, _, _, position, turn in stamped:
            back, latest = back + (time_ns < latest), time_ns
            try:
                pose = pose_of_parts(position, turn, field="a pose")
            except InvalidPose as error:
                problems.append(error.detail)
                continue
            twice += time_ns in found and not np.allclose(found[time_ns], pose, atol=SAME)
            found[time_ns] = pose
        if not found:
            unit = " (millimetres where metres are expected?)" if "lie within" in problems[0] else ""
            raise DatasetInvalid(
                f"{self._path}: none of the {len(stamped)} poses of {name} is one: {problems[0]}{unit}"
            )
        times = sorted(found)
        track = PoseTrack(np.array(times, np.int64), np.array([found[time_ns] for time_ns in times]))
        lost = len({time_ns for time_ns, *_ in stamped} - set(times))
        to_and_fro_mm = goes_to_and_fro_mm(track.poses[:, :3, 3])
        unstamped = sum(not has_stamp for _, _, has_stamp, *_ in stamped)
        notes = (
            f"{unstamped} poses of {name} have no stamp: taken for those of the time that they were written at"
            if unstamped == len(stamped) > 1
            else "",
            f"the poses of {name} go {to_and_fro_mm:.3g} mm to and fro from one to the next: do two sources tell them?"
            if to_and_fro_mm
            else "",
            f"{lost} poses of {name} are none, such as of a probe that was lost, and were passed over" if lost else "",
            f"{twice} poses of {name} have the stamp of another one: the last of them is taken" if twice else "",
            f"the stamps of {name} step back {back} times: its poses were put in their order" if back else "",
        )
        return track, tuple(note for note in notes if note)


def _written_ns(stamped: Sequence[_Stamped]) -> int:
    """How long after their stamps messages were written, usually."""
    return int(np.median([written - stamp for stamp, written, *_ in stamped]))


def _name_of(transform: Any) -> TransformName:
    """Child and parent."""
    return transform.child_frame_id.lstrip("/"), transform.header.frame_id.lstrip("/")


def _stamped(transform: Any, message: StoredMessage) -> _Stamped:
    parts = transform.transform.translation, transform.transform.rotation
    return *_times_of(transform.header, message), *parts


def _times_of(header: Any, message: StoredMessage) -> tuple[int, int, bool]:
    return time_of(header, message.log_time_ns), message.log_time_ns, time_of(header, 0) != 0


# A recorded sweep out of an MCAP file: one topic of images, the poses at their times, and their geometry.
#
# The file is read three times, a message at a time: for poses and geometry, for the times of the images that were
# chosen, and for the pixels of those that have a pose.


PREFERRED_IMAGES, PREFERRED_POSES, GEOMETRY = "/bmode", "/probe_pose", "/geometry"  # ends of the node's topics


def read_mcap_sweep(
    path: Path,
    *,
    frames: str | None = None,
    crop: str | None = None,
    transform: str | None = None,
    image_topic: str | None = None,
    pose_topic: str | None = None,
    image_delay_ms: str | None = None,
) -> tuple[Sweep, int]:
    """The images of one topic that have a pose, and how many images it has.

    `frames` (ranges, `parse_frame_ranges`) chooses among them; `crop` is "columns,rows" of images of a linear probe.
    Of several topics, that of images which ends in /bmode and that of poses which ends in /probe_pose are taken unless
    `image_topic` and `pose_topic` name others; `/tf` stands for the transforms of tf, of which `transform`, such as
    probeTobase, names two frames. A pose lies between those before and after the image (position linear, orientation
    by slerp), at most 0.2 s apart; the notes say how many images have none. `image_delay_ms` is by how much the images
    are stamped later than the poses. Raises DatasetInvalid, naming the file, the frame and the reason; InvalidArgument
    for options that do not fit.
    """
    delay_ns = parse_delay_ns(image_delay_ms)
    file = MessageFile(path)
    contents = _Contents(file)
    topic = _chosen(path, "image_topic", image_topic, sorted(contents.image_counts), PREFERRED_IMAGES, contents)
    source = _chosen(path, "pose_topic", pose_topic, contents.poses.topics, PREFERRED_POSES, contents)
    count = contents.image_counts[topic]
    numbers = range(count) if frames is None else parse_frame_ranges(frames, count, option="frames")
    times = _ImageTimes(file, topic, numbers)
    way = contents.poses.way(source, times.frame_id, transform)
    poses, known = way.at(times.times_ns - delay_ns)
    if not known.any():
        raise DatasetInvalid(f"{path}: none of {len(known)} images has a pose: {_why_none(times, delay_ns, way)}")
    with_pose = times.numbers[known]
    geometry, geometry_source = contents.geometry_of(topic, times.log_times_ns[known], with_pose)
    images, pixel_notes = _read_images(file, topic, with_pose)
    is_guessed = source == TF and transform is None
    notes = (
        *_notes(file, way, is_guessed, times.numbers[~known]),
        *_path_notes(times, way),
        *pixel_notes,
        *delay_note(delay_ns),
    )
    times_s = (times.times_ns[known] - times.times_ns.min()) / NS_PER_S
    sweep = geometry.sweep(images, poses[known], with_pose, path, notes, crop, times_s)
    pixels = Link("pixels", way.links[0].origin, "geometry", geometry_source)
    return replace(sweep, chain=Chain((pixels, *way.links), way.left_out)), count


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

    def geometry_of(self, topic: str, log_times_ns: IntArray, numbers: IntArray) -> tuple[ImageGeometry, str]:
        """The one geometry of images, and where it is from. Raises DatasetInvalid where there is none, or it changes
        among them."""
        if (given := geometry_beside(self._path)) is not None:
            return given, f"{self._path.stem}{BESIDE}"
        near = [one for name, one in self._geometries.items() if topic.startswith(name.removesuffix(GEOMETRY[1:]))]
        if len(near) != 1:
            raise DatasetInvalid(
                f"{self._path}: it does not say which probe its images are of, on a topic beside {topic} that ends in "
                f"{GEOMETRY}: say it in {self._path.stem}{BESIDE} beside the file, such as "
                '{"probe": {"kind": "linear", "width_mm": 40, "near_mm": 0, "far_mm": 50}}'
            )
        entries = sorted(near[0])
        times = [time_ns for time_ns, _ in entries]
        texts = [entries[max(0, bisect_right(times, int(time_ns)) - 1)][1] for time_ns in log_times_ns]
        known = {text: read_geometry(text, str(self._path)) for text in dict.fromkeys(texts)}
        for number, text in zip(numbers, texts, strict=True):
            if known[text] != known[texts[0]]:
                raise DatasetInvalid(
                    f"{self._path}: frame {number}: its geometry, {known[text].probe}, is another one than that of "
                    f"frame {numbers[0]}, {known[texts[0]].probe}: was the depth changed? Choose those of one geometry "
                    f"with frames, such as {numbers[0]}:{number}"
                )
        (near_topic,) = (name for name, texts_near in self._geometries.items() if texts_near is near[0])
        return known[texts[0]], near_topic


def _chosen(path: Path, option: str, choice: str | None, topics: list[str], preferred: str, contents: _Contents) -> str:
    """The topic that was asked for; else the only one, or the only one that ends as the node's do."""
    noun = option.removesuffix("_topic") + "s"
    listed = ", ".join(topics) or ", ".join(f"{topic} ({kind})" for topic, kind in sorted(contents.kinds.items()))
    if choice is not None:
        if choice not in topics:
            raise InvalidArgument(f"{option} must be one of {listed or 'no topics'}, got {choice[:80]!r}", field=option)
        return choice
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
        found, frames, self.without_stamp = [], Counter[str](), 0
        for number, message in _chosen_images(file, topic, numbers):
            header = message.decode().header
            frames[header.frame_id.lstrip("/")] += 1
            self.without_stamp += time_of(header, 0) == 0 != message.log_time_ns
            found.append((number, time_of(header, message.log_time_ns), message.log_time_ns))
        if len(frames) > 1:
            listed = " and ".join(f"{name!r} ({count} images)" for name, count in sorted(frames.items()))
            raise DatasetInvalid(f"{file.path}: the images of {topic} must be of one probe, their frame_id is {listed}")
        self.frame_id = next(iter(frames), "")
        self.numbers, self.times_ns, self.log_times_ns = np.array(found, np.int64).reshape(-1, 3).T

    @property
    def written_ns(self) -> int:
        """How long after their stamps images were written, usually."""
        return int(np.median(self.log_times_ns - self.times_ns))


def _read_images(
    file: MessageFile, topic: str, numbers: IntArray
) -> tuple[ByteArray, tuple[str, ...]]:  # [F, rows, columns]
    """The frames, and what is to be told of them. Raises DatasetInvalid, naming the frame, where the size changes, or
    all of them are too large."""
    images: np.ndarray | None = None
    for place, (number, message) in enumerate(_chosen_images(file, topic, numbers)):
        image = grey_image(message.decode(), message.kind, f"{file.path}: frame {number}")
        if images is None:
            if image.nbytes * len(numbers) > MAX_PIXEL_BYTES:
                raise DatasetInvalid(
                    f"{file.path}: its frames must have at most {MAX_PIXEL_BYTES:,} pixels, {len(numbers)} of "
                    f"{image.shape[1]} x {image.shape[0]} have more: choose some with frames"
                )
            images = np.empty((len(numbers), *image.shape), image.dtype)
        if image.dtype != images.dtype:
            raise DatasetInvalid(f"{file.path}: frame {number} is of {image.dtype}, frame {numbers[0]} {images.dtype}")
        if image.shape != images.shape[1:]:
            first = numbers[0]
            raise DatasetInvalid(
                f"{file.path}: frame {number} has {image.shape[1]} x {image.shape[0]} pixels, frame {first} "
                f"{images.shape[2]} x {images.shape[1]}: choose those of one size with frames, such as {first}:{number}"
            )
        images[place] = image
    assert images is not None  # there are numbers
    return eight_bits(images, str(file.path))


def _why_none(times: _ImageTimes, delay_ns: int, way: Way) -> str:
    begin, end = (time_ns / NS_PER_S for time_ns in way.span_ns)
    stamps = times.times_ns - delay_ns
    first, last = stamps.min() / NS_PER_S, stamps.max() / NS_PER_S
    if last < begin or end < first:
        apart_ms = (way.written_ns - times.written_ns) / NS_PER_MS
        by_writing = f" (by the times of writing {apart_ms:.0f} ms apart: --image-delay-ms {apart_ms:.0f})"
        return (
            f"images are stamped {first:.3f} to {last:.3f} s, poses of {way.name} {begin:.3f} to {end:.3f} s: were the "
            f"clocks other ones{by_writing if abs(apart_ms) > SLOW_PATH_NS / NS_PER_MS else ''}?"
        )
    return f"those of {way.name} before and after an image must be at most {MAX_GAP_NS / 1e6:g} ms apart"


def _path_notes(times: _ImageTimes, way: Way) -> tuple[str, ...]:
    """What the times of writing tell of the two clocks."""
    if times.without_stamp:
        images = "1 image has" if times.without_stamp == 1 else f"{times.without_stamp} images have"
        return (f"{images} no stamp: the time of writing is taken for it",)
    apart_ms = (way.written_ns - times.written_ns) / NS_PER_MS
    if abs(apart_ms) <= SLOW_PATH_NS / NS_PER_MS:
        return ()
    return (
        f"images were written {times.written_ns / NS_PER_MS:.0f} ms after their stamps, poses of {way.name} "
        f"{way.written_ns / NS_PER_MS:.0f} ms: one of them comes slowly, or their clocks differ; then "
        f"--image-delay-ms {apart_ms:.0f} corrects it",
    )


def _notes(file: MessageFile, way: Way, is_way_guessed: bool, left_out: IntArray) -> tuple[str, ...]:
    notes = []
    if file.broke_off:
        notes.append("the file breaks off: its recording was not finished; it was read as far as it goes")
    if is_way_guessed:
        notes.append(f"poses are taken from tf: {way.name}")
    notes += way.notes
    if len(left_out):
        notes.append(
            f"images without poses at most {MAX_GAP_NS / 1e6:g} ms apart around them were left out: "
            f"{frame_list(left_out)} "
            f"({len(left_out)} in all)"
        )
    return tuple(notes)

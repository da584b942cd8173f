"""Pictures in a folder and a table of their poses: `poses.csv`, `calibration.json`, and .png, .jpg, .bmp or .tif files.

A row of the table is a pose of the sensor on the probe in the tracker's frame: a position, and a quaternion or angles.
Columns are known by their names, which may end in their unit: `time_s`, `x_mm`, `rx_deg`. The calibration says what
they do not.
"""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path, PurePosixPath
from typing import Literal

import cv2
import numpy as np

from ultragray.contract import Contract, described, from_dict
from ultragray.datasets.clocks import (
    LONGEST_STEP_S,
    MAX_GAP_NS,
    NS_PER_S,
    BoolArray,
    PoseTrack,
    delay_note,
    parse_delay_ns,
    times_of_all,
)
from ultragray.datasets.fan import tracked_sweep
from ultragray.datasets.images import MAX_PIXEL_BYTES, eight_bits
from ultragray.datasets.source import advice_for
from ultragray.errors import DatasetInvalid, InvalidPose
from ultragray.geometry.pose import pose_from_position_quaternion
from ultragray.geometry.probe import FloatArray
from ultragray.learn.sweep import ByteArray, Chain, IntArray, Link, Sweep, frame_list, parse_frame_ranges

POSES, TIMES, CALIBRATION = "poses.csv", "images.csv", "calibration.json"
PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
MAX_TABLE_BYTES, MAX_CALIBRATION_BYTES = 256 << 20, 1 << 20
LENGTHS = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
ANGLES = {"deg": np.pi / 180, "rad": 1.0}
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_FILE = ("file", "filename", "image", "frame_file")
_TIME = ("time", "timestamp", "stamp", "t")
_POSITIONS = (("x", "y", "z"), ("tx", "ty", "tz"), ("px", "py", "pz"), ("pos_x", "pos_y", "pos_z"))
_QUATERNIONS = (
    ("qw", "qx", "qy", "qz"),
    ("q0", "qx", "qy", "qz"),  # NDI's
    ("q_w", "q_x", "q_y", "q_z"),
    ("quat_w", "quat_x", "quat_y", "quat_z"),
)
_EULER = (("rx", "ry", "rz"), ("roll", "pitch", "yaw"), ("euler_x", "euler_y", "euler_z"))
_BRACKETS = re.compile(r"\s*[\[(](.*)[\])]$")  # around a unit: "x [mm]"
NO_NUMBER = ("", "null", "nan", "na", "n/a", "none", "-", "--", "missing")  # cells of a row without a pose


@dataclass(frozen=True)
class TableCalibration(Contract):
    """What a table of poses does not say itself."""

    image_to_sensor: tuple[float, ...] = described(
        "From pixels (column, row, 0), counted from 0, to the sensor's mm: 16 numbers row by row."
    )
    position_unit: Literal["mm", "cm", "m"] | None = described("Of positions whose columns name none.", None)
    angle_unit: Literal["deg", "rad"] | None = described("Of angles whose columns name none.", None)
    euler_order: str | None = described(
        "Axes in the order of the turns: capitals about the turned axes, such as ZYX, small letters about fixed ones.",
        None,
    )


def read_table_sweep(
    path: Path,
    *,
    frames: str | None = None,
    crop: str | None = None,
    fan: str | None = None,
    calibration: Path | None = None,
    image_delay_ms: str | None = None,
) -> tuple[Sweep, int]:
    """The pictures that have a pose, and how many there are; `path` is the folder or its poses.csv.

    A row with a `file` goes with that picture; else, with an `images.csv` of `file` and `time`, poses lie between the
    rows before and after (at most 0.2 s apart); else rows go with the pictures in the order of the numbers in their
    names. `image_delay_ms` is by how much pictures are stamped later than poses. Raises DatasetInvalid, naming file and
    row; InvalidArgument for options that do not fit.
    """
    delay_ns = parse_delay_ns(image_delay_ms)
    table_path = path / POSES if path.is_dir() else path
    folder = table_path.parent
    known = _read_calibration(calibration or folder / CALIBRATION)
    table = _Table.read(table_path)
    poses, has_pose, angle_notes = _poses(table, known)
    times_s = table.times_s()
    pictures, poses, has_pose, image_times_s, left_notes = _matched(folder, table, poses, has_pose, times_s, delay_ns)
    count = len(pictures)
    numbers = np.arange(count) if frames is None else np.array(parse_frame_ranges(frames, count, option="frames"))
    left_out, numbers = numbers[~has_pose[numbers]], numbers[has_pose[numbers]]
    is_between = delay_ns != 0 or (folder / TIMES).is_file()
    pose = f"pose between rows at most {MAX_GAP_NS / 1e6:g} ms apart" if is_between else "pose"
    if not len(numbers):
        raise DatasetInvalid(f"{table_path}: none of {count} pictures has a {pose}")
    notes = (*angle_notes, *left_notes, *delay_note(delay_ns))
    if len(left_out):
        notes += (f"pictures without a {pose} were left out: {frame_list(left_out)} ({len(left_out)} in all)",)
    calibration_name = (calibration or folder / CALIBRATION).name
    chain = Chain(
        (
            Link("pixels", "sensor", "image_to_sensor", calibration_name),
            Link("sensor", "tracker", f"pose ({table.words(known)})", table_path.name, is_tracked=True),
        )
    )
    chosen_s, time_notes = (None, ()) if image_times_s is None else times_of_all(image_times_s[numbers])
    images, pixel_notes = _read_pictures([pictures[number] for number in numbers])
    sweep = tracked_sweep(
        images,
        poses[numbers],
        np.array(known.image_to_sensor).reshape(4, 4),
        numbers,
        table_path,
        crop=crop,
        fan=fan,
        calibration=f"{calibration_name}: image_to_sensor",
        chain=chain,
        notes=notes + pixel_notes + time_notes,
        times_s=chosen_s,
    )
    return sweep, count


def _read_calibration(path: Path) -> TableCalibration:
    if not path.is_file() or path.stat().st_size > MAX_CALIBRATION_BYTES:
        raise DatasetInvalid(
            f"{path}: no calibration: a table of poses needs one with image_to_sensor, from pixels to the sensor's mm"
        )
    try:
        document = json.loads(path.read_bytes())
        if isinstance(document, dict) and isinstance(document.get("image_to_sensor"), list):
            document["image_to_sensor"] = np.array(document["image_to_sensor"], float).ravel().tolist()
        found = from_dict(TableCalibration, document)
        matrix = np.array(found.image_to_sensor, float)
        if matrix.shape != (16,) or not np.isfinite(matrix).all() or matrix[12:].tolist() != [0, 0, 0, 1]:
            raise ValueError("image_to_sensor must be 16 finite numbers that end in 0 0 0 1")
        order = found.euler_order
        if order is not None and "".join(sorted(order)) not in ("XYZ", "xyz"):
            raise ValueError(f"euler_order must be the three letters XYZ or xyz in an order, got {order[:20]!r}")
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise DatasetInvalid(f"{path}: the calibration cannot be read: {error}") from error
    return found


@dataclass(frozen=True)
class _Table:
    path: Path
    columns: Mapping[str, int]  # by the name in lower case
    repeated: frozenset[str]  # names that several columns have
    rows: Sequence[Sequence[str]]
    has_decimal_commas: bool

    @classmethod
    def read(cls, path: Path) -> _Table:
        """A row of names and rows of cells, between semicolons, tabs, commas or spaces.

        Names may stand in a comment before the rows, as TUM's tools write it. Raises DatasetInvalid.
        """
        if not path.is_file() or path.stat().st_size > MAX_TABLE_BYTES:
            raise DatasetInvalid(f"{path}: no table that can be read: it is missing, or too large")
        try:
            lines = [line for line in path.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
        except UnicodeDecodeError as error:
            raise DatasetInvalid(f"{path}: it cannot be read as a table of UTF-8: {error}") from error
        comments = list(takewhile(lambda line: line.lstrip().startswith("#"), lines))
        rest = [line for line in lines[len(comments) :] if not line.lstrip().startswith("#")]
        if comments and (not rest or re.match(r"\s*[-+.\d]", rest[0])):
            rest = [comments[-1].lstrip("# "), *rest]
        if len(rest) < 2:
            found = f"only one row, {rest[0]!r:.80}" if rest else "no rows"
            raise DatasetInvalid(f"{path}: it must have a row of names and rows of numbers below it, it has {found}")
        separator = next((one for one in ";\t," if one in rest[0]), None)
        try:
            cells = (line.split() for line in rest) if separator is None else csv.reader(rest, delimiter=separator)
            first, *rows = cells
        except (csv.Error, ValueError) as error:
            raise DatasetInvalid(f"{path}: it cannot be read as a table with a row of names: {error}") from error
        for number, row in enumerate(rows, 2):
            if any(cell.strip() for cell in row[len(first) :]):
                raise DatasetInvalid(
                    f"{path}: row {number}: it has {len(row)} cells under {len(first)} names: commas in its numbers?"
                )
        names = [_BRACKETS.sub(r"_\1", name.strip().lower()).replace("°", "deg") for name in first]
        repeated = frozenset(name for name, count in Counter(names).items() if count > 1)
        return cls(path, {name: place for place, name in enumerate(names)}, repeated, rows, separator != ",")

    def find(self, names: Sequence[str], units: Mapping[str, float]) -> tuple[list[int], str | None] | None:
        """The columns of these names, bare or all with one unit at their end; None where they are not all there."""
        for unit in (None, *units):
            wanted = [name if unit is None else f"{name}_{unit}" for name in names]
            if all(name in self.columns for name in wanted):
                if twice := self.repeated & {*wanted}:
                    raise DatasetInvalid(
                        f"{self.path}: several columns are called {min(twice)}: leave those of one tracked thing"
                    )
                return [self.columns[name] for name in wanted], unit
        return None

    def values(self, places: Sequence[int]) -> FloatArray:  # [N, K]; a cell of NO_NUMBER is NaN
        found = np.full((len(self.rows), len(places)), np.nan)
        for number, row in enumerate(self.rows):
            for column, place in enumerate(places):
                cell = row[place].strip() if place < len(row) else ""
                if cell.lower() in NO_NUMBER:
                    continue
                try:
                    found[number, column] = float(cell.replace(",", ".") if self.has_decimal_commas else cell)
                except ValueError:
                    name = next(name for name, at in self.columns.items() if at == place)
                    hint = ": write dates and hours as seconds" if ":" in cell else ""
                    raise DatasetInvalid(
                        f"{self.path}: row {number + 2}: {name} must be a number, got {cell[:40]!r}{hint}"
                    ) from None
        return found

    def texts(self, names: Sequence[str]) -> list[str] | None:
        place = next((self.columns[name] for name in names if name in self.columns), None)
        return None if place is None else [row[place].strip() if place < len(row) else "" for row in self.rows]

    def times_s(self) -> FloatArray | None:  # [N]
        """Raises DatasetInvalid for times without a unit that are no seconds by their steps."""
        for name in _TIME:
            if (found := self.find([name], SECONDS)) is None:
                continue
            times = self.values(found[0])[:, 0]
            usual = float(np.median(np.abs(np.diff(times[np.isfinite(times)])))) if len(times) > 2 else 0.0
            if found[1] is None and usual > LONGEST_STEP_S:
                raise DatasetInvalid(
                    f"{self.path}: its column {name} has no unit and steps of {usual:.6g}, which are no seconds: name "
                    f"it {name}_ms, {name}_us or {name}_ns (or {name}_s, if they are)"
                )
            return times * SECONDS[found[1] or "s"]
        return None

    def words(self, known: TableCalibration) -> str:
        """How its columns are read."""
        _, unit, names = self.position(known)
        turn = self.euler(known)
        return f"{', '.join(names)} in {unit}, " + ("quaternion" if turn is None else f"angles {turn[2]} in {turn[1]}")

    def position(self, known: TableCalibration) -> tuple[list[int], str, Sequence[str]]:
        for names in _POSITIONS:
            if (found := self.find(names, LENGTHS)) is not None:
                unit = found[1] or known.position_unit
                if unit is None:
                    raise DatasetInvalid(
                        f"{self.path}: it does not say in which unit its positions are: name columns such as "
                        f"{names[0]}_mm, or position_unit in the calibration"
                    )
                return found[0], unit, names
        raise self._lacks("a position (x, y, z)")

    def quaternion(self) -> list[int] | None:
        return next((found[0] for names in _QUATERNIONS if (found := self.find(names, {})) is not None), None)

    def euler(self, known: TableCalibration) -> tuple[list[int], str, str] | None:
        """Columns, unit and order of the angles; None where there is a quaternion."""
        if self.quaternion() is not None:
            return None
        for names in _EULER:
            if (found := self.find(names, ANGLES)) is not None:
                unit = found[1] or known.angle_unit
                if unit is None or known.euler_order is None:
                    raise DatasetInvalid(
                        f"{self.path}: angles need their unit and order: columns such as {names[0]}_deg or angle_unit, "
                        "and euler_order, such as ZYX, in the calibration"
                    )
                return found[0], unit, known.euler_order
        raise self._lacks("a quaternion (qw, qx, qy, qz) or angles (rx, ry, rz)")

    def _lacks(self, what: str) -> DatasetInvalid:
        return DatasetInvalid(f"{self.path}: it lacks columns of {what}, it has {', '.join(self.columns)[:200]}")


def _poses(table: _Table, known: TableCalibration) -> tuple[FloatArray, BoolArray, tuple[str, ...]]:
    """The pose of each row, [N, 4, 4], whether it has one, [N], and what is odd about its angles."""
    places, unit, _ = table.position(known)
    positions = table.values(places) * LENGTHS[unit]
    turn, poses = table.euler(known), np.tile(np.eye(4), (len(table.rows), 1, 1))
    columns = table.quaternion() if turn is None else turn[0]
    turns = table.values(columns or [])
    has_pose: BoolArray = np.isfinite(np.concatenate([positions, turns], axis=1)).all(axis=1)
    if turn is None:
        has_pose &= turns.any(axis=1)  # a tracker that has lost the probe writes 0 0 0 0
    for number in np.flatnonzero(has_pose):
        x, y, z = positions[number].tolist()
        try:
            if turn is None:
                w, i, j, k = turns[number].tolist()
                poses[number] = pose_from_position_quaternion((x, y, z), (w, i, j, k), field="its pose")
            else:
                poses[number, :3, :3] = rotation_of_angles(turns[number] * ANGLES[turn[1]], turn[2])
                poses[number, :3, 3] = x, y, z
        except InvalidPose as error:
            raise DatasetInvalid(f"{table.path}: row {number + 2}: {error}") from error
    largest = float(np.abs(turns[has_pose]).max(initial=0.0)) if turn is not None and turn[1] == "rad" else 0.0
    if largest > 2 * np.pi:
        return poses, has_pose, (f"its angles in rad go up to {largest:.4g}, beyond a whole turn: are they degrees?",)
    return poses, has_pose, ()


def rotation_of_angles(angles: FloatArray, order: str) -> FloatArray:  # [3] rad about x, y, z -> [3, 3]
    """Turns about the axes in an order: capitals about the axes as they were turned, small letters about fixed ones."""
    rotation = np.eye(3)
    for axis in order.upper():
        place = "XYZ".index(axis)
        step = cv2.Rodrigues(np.eye(3)[place] * angles[place])[0]
        rotation = rotation @ step if order.isupper() else step @ rotation
    return rotation


def _matched(
    folder: Path,
    table: _Table,
    poses: FloatArray,
    has_pose: BoolArray,
    times_s: FloatArray | None,
    delay_ns: int,
) -> tuple[list[Path], FloatArray, BoolArray, FloatArray | None, tuple[str, ...]]:
    """The pictures, the pose of each and whether it is known, their times, and which pictures have no row."""
    notes: tuple[str, ...] = ()
    stamped = _Table.read(folder / TIMES) if (folder / TIMES).is_file() else None
    files = (stamped or table).texts(_FILE)
    paths = [str(PurePosixPath(name.replace("\\", "/"))) for name in files or ()]  # also ./a.png and images\a.png
    pictures = _pictures(folder, paths[0] if paths else None)
    by_name = {path.name: path for path in pictures} | {str(path.relative_to(folder)): path for path in pictures}
    if files is None:
        _check_order(folder, pictures)
    else:
        if missing := [name for name, where in zip(files, paths, strict=True) if where not in by_name]:
            raise DatasetInvalid(f"{(stamped or table).path}: the picture {missing[0][:80]!r} was not found beside it")
        named = [by_name[where] for where in paths]
        kept = {*named}
        if unnamed := [path.name for path in pictures if path not in kept]:
            listed = ", ".join(unnamed[:5]) + (", …" if len(unnamed) > 5 else "")
            table_name = (stamped or table).path.name
            notes = (f"pictures without a row in {table_name} were left out: {listed} ({len(unnamed)} in all)",)
        pictures = named
    image_times_s = times_s if stamped is None else stamped.times_s()
    if stamped is None and len(pictures) != len(poses):
        raise DatasetInvalid(
            f"{table.path}: it has {len(poses)} poses for {len(pictures)} pictures: name them in a column file, or "
            f"their times in {TIMES}"
        )
    if stamped is None and not delay_ns:
        return pictures, poses, has_pose, times_s, notes
    if times_s is None or image_times_s is None or not np.isfinite(image_times_s).all():
        raise DatasetInvalid(f"{table.path}: poses between its rows need a column time for rows and pictures")
    usable = has_pose & np.isfinite(times_s)
    times_ns, places = np.unique(_nanoseconds(times_s[usable], times_s), return_index=True)
    if not len(places):
        raise DatasetInvalid(f"{table.path}: none of its rows has a pose and a time")
    track = PoseTrack(times_ns, poses[usable][places])
    taken_s, rows_s = image_times_s - delay_ns / NS_PER_S, times_s[usable]
    if taken_s.max() < rows_s.min() or rows_s.max() < taken_s.min():
        raise DatasetInvalid(
            f"{table.path}: none of {len(pictures)} pictures has a pose: pictures are of {taken_s.min():.3f} to "
            f"{taken_s.max():.3f} s, rows of {rows_s.min():.3f} to {rows_s.max():.3f} s: were the clocks other "
            "ones, or is a unit wrong?"
        )
    found, known = track.at(_nanoseconds(image_times_s, times_s) - delay_ns)
    return pictures, found, known, image_times_s, notes


def _nanoseconds(times_s: FloatArray, all_s: FloatArray) -> IntArray:
    return np.round((times_s - np.nanmin(all_s)) * NS_PER_S).astype(np.int64)


def _pictures(folder: Path, named: str | None) -> list[Path]:
    """Those in the folder, else in its one folder of pictures, in the order of the numbers in their names.

    Of several folders it is the one that holds the picture `named`. Raises DatasetInvalid where that is not one.
    """
    found: dict[Path, list[Path]] = {}
    for path in (*folder.iterdir(), *folder.glob("*/*")):
        if path.suffix.lower() in PICTURES and path.is_file() and not _is_hidden(path.relative_to(folder)):
            found.setdefault(path.parent, []).append(path)
    if not found:
        raise DatasetInvalid(
            f"{folder}: it holds no pictures ({', '.join(PICTURES)}){advice_for(sorted(folder.iterdir()))}"
        )
    with_named = {
        place for place, them in found.items() for path in them if named in (path.name, str(path.relative_to(folder)))
    }
    places = sorted(with_named or found)
    if len(places) > 1 and folder not in places:
        listed = ", ".join(place.name for place in places[:5])
        raise DatasetInvalid(
            f"{folder}: pictures lie in several folders, {listed}: name them as FOLDER/NAME in a column file"
        )
    return sorted(found[places[0]], key=lambda path: [int(one) if one.isdigit() else one for one in _parts(path.name)])


def _is_hidden(path: Path) -> bool:
    """Whether it is of the files that a file system or an archiver leaves beside others, such as ._frame_0.png."""
    return any(part.startswith((".", "__MACOSX")) for part in path.parts)


def _check_order(folder: Path, pictures: Sequence[Path]) -> None:
    """Refuse names such as 12.5.png and 12.25.png, which are in another order as fractions and as whole numbers."""
    found = [re.search(r"\d+\.\d+$", path.stem) for path in pictures]
    times = [float(match[0]) for match in found if match]
    if len(times) == len(pictures) and times != sorted(times):
        raise DatasetInvalid(
            f"{folder}: the order of its pictures cannot be told from names such as {pictures[0].name[:80]}: name them "
            "in a column file"
        )


def _parts(name: str) -> list[str]:
    """Words and numbers in turn, so that 9 comes before 10."""
    return re.split(r"(\d+)", name)


def _read_pictures(paths: Sequence[Path]) -> tuple[ByteArray, tuple[str, ...]]:  # [F, rows, columns]
    """Pictures of one size as grey ones of 8 bits, and what is to be told of it."""
    images: np.ndarray | None = None
    for place, path in enumerate(paths):
        found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
        if found is None or found.dtype not in (np.uint8, np.uint16):
            raise DatasetInvalid(f"{path}: it cannot be read as a picture of 8 or 16 bits")
        if found.ndim == 3:
            found = cv2.cvtColor(np.ascontiguousarray(found[:, :, :3]), cv2.COLOR_BGR2GRAY)
        if images is None:
            if found.nbytes * len(paths) > MAX_PIXEL_BYTES:
                raise DatasetInvalid(f"{path.parent}: its pictures have over {MAX_PIXEL_BYTES >> 30} GiB")
            images = np.empty((len(paths), *found.shape), found.dtype)
        if found.shape != images.shape[1:] or found.dtype != images.dtype:
            raise DatasetInvalid(
                f"{path}: it has {found.shape[1]} x {found.shape[0]} pixels of {found.dtype}, {paths[0].name} "
                f"{images.shape[2]} x {images.shape[1]} of {images.dtype}"
            )
        images[place] = found
    assert images is not None  # there are paths
    return eight_bits(images, str(paths[0].parent))

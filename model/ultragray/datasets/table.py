"""Pictures in a folder and a table of their poses: `poses.csv`, `calibration.json`, and .png, .jpg, .bmp or .tif files.

A row of the table is a pose of the sensor on the probe in the tracker's frame: a position, and a quaternion or angles.
Columns are known by their names, which may end in their unit: `time_s`, `x_mm`, `rx_deg`. The calibration says what
they do not.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from ultragray.contract import Contract, described, from_dict
from ultragray.datasets.clocks import NS_PER_S, BoolArray, PoseTrack, delay_note, parse_delay_ns
from ultragray.datasets.fan import tracked_sweep
from ultragray.datasets.images import MAX_PIXEL_BYTES, grey_frames
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
_QUATERNIONS = (("qw", "qx", "qy", "qz"), ("q_w", "q_x", "q_y", "q_z"), ("quat_w", "quat_x", "quat_y", "quat_z"))
_EULER = (("rx", "ry", "rz"), ("roll", "pitch", "yaw"), ("euler_x", "euler_y", "euler_z"))


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
    poses, has_pose = _poses(table, known)
    times_s = table.times_s()
    pictures, poses, has_pose, image_times_s = _matched(folder, table, poses, has_pose, times_s, delay_ns)
    count = len(pictures)
    numbers = np.array(range(count) if frames is None else parse_frame_ranges(frames, count, option="frames"))
    left_out, numbers = numbers[~has_pose[numbers]], numbers[has_pose[numbers]]
    if not len(numbers):
        raise DatasetInvalid(f"{table_path}: none of {count} pictures has a pose")
    notes = delay_note(delay_ns)
    if len(left_out):
        notes += (f"pictures without a pose were left out: {frame_list(left_out)} ({len(left_out)} in all)",)
    calibration_name = (calibration or folder / CALIBRATION).name
    chain = Chain(
        (
            Link("pixels", "sensor", "image_to_sensor", calibration_name),
            Link("sensor", "tracker", f"pose ({table.words(known)})", table_path.name, is_tracked=True),
        )
    )
    sweep = tracked_sweep(
        _read_pictures([pictures[number] for number in numbers]),
        poses[numbers],
        np.array(known.image_to_sensor).reshape(4, 4),
        numbers,
        table_path,
        crop=crop,
        fan=fan,
        calibration=f"{calibration_name}: image_to_sensor",
        chain=chain,
        notes=notes,
        times_s=None if image_times_s is None or not np.isfinite(image_times_s).all() else image_times_s[numbers],
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
        if found.euler_order is not None and not re.fullmatch(r"[XYZ]{3}|[xyz]{3}", found.euler_order):
            raise ValueError(f"euler_order must be three of XYZ or of xyz, got {found.euler_order[:20]!r}")
    except (ValueError, TypeError, RecursionError) as error:
        raise DatasetInvalid(f"{path}: the calibration cannot be read: {error}") from error
    return found


@dataclass(frozen=True)
class _Table:
    path: Path
    columns: Mapping[str, int]  # by the name in lower case
    rows: Sequence[Sequence[str]]

    @classmethod
    def read(cls, path: Path) -> _Table:
        if not path.is_file() or path.stat().st_size > MAX_TABLE_BYTES:
            raise DatasetInvalid(f"{path}: no table that can be read: it is missing, or too large")
        try:
            text = path.read_text(encoding="utf-8-sig")
            dialect = csv.Sniffer().sniff(text[:4096].partition("\n")[0], delimiters=",;\t ")
            first, *rows = (row for row in csv.reader(text.splitlines(), dialect) if row)
        except (UnicodeDecodeError, csv.Error, ValueError) as error:
            raise DatasetInvalid(f"{path}: it cannot be read as a table with a row of names: {error}") from error
        return cls(path, {name.strip().lower(): place for place, name in enumerate(first)}, rows)

    def find(self, names: Sequence[str], units: Mapping[str, float]) -> tuple[list[int], str | None] | None:
        """The columns of these names, bare or all with one unit at their end; None where they are not all there."""
        for unit in (None, *units):
            wanted = [name if unit is None else f"{name}_{unit}" for name in names]
            if all(name in self.columns for name in wanted):
                return [self.columns[name] for name in wanted], unit
        return None

    def values(self, places: Sequence[int]) -> FloatArray:  # [N, K]; an empty cell is NaN
        found = np.full((len(self.rows), len(places)), np.nan)
        for number, row in enumerate(self.rows):
            try:
                cells = [row[place].strip() for place in places]
                found[number] = [float(cell) if cell and cell.lower() != "null" else np.nan for cell in cells]
            except (IndexError, ValueError):
                raise DatasetInvalid(f"{self.path}: row {number + 2}: it must have numbers, got {row!r:.80}") from None
        return found

    def texts(self, names: Sequence[str]) -> list[str] | None:
        place = next((self.columns[name] for name in names if name in self.columns), None)
        return None if place is None else [row[place].strip() if place < len(row) else "" for row in self.rows]

    def times_s(self) -> FloatArray | None:  # [N]
        for name in _TIME:
            if (found := self.find([name], SECONDS)) is not None:
                return self.values(found[0])[:, 0] * SECONDS[found[1] or "s"]
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


def _poses(table: _Table, known: TableCalibration) -> tuple[FloatArray, BoolArray]:  # [N, 4, 4], [N]
    """The pose of each row, and whether it has one."""
    places, unit, _ = table.position(known)
    positions = table.values(places) * LENGTHS[unit]
    turn, poses = table.euler(known), np.tile(np.eye(4), (len(table.rows), 1, 1))
    columns = table.quaternion() if turn is None else turn[0]
    turns = table.values(columns or [])
    has_pose: BoolArray = np.isfinite(np.concatenate([positions, turns], axis=1)).all(axis=1)
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
    return poses, has_pose


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
) -> tuple[list[Path], FloatArray, BoolArray, FloatArray | None]:
    """The pictures, the pose of each and whether it is known, and their times."""
    pictures = _pictures(folder)
    by_name = {path.name: path for path in pictures} | {str(path.relative_to(folder)): path for path in pictures}
    stamped = _Table.read(folder / TIMES) if (folder / TIMES).is_file() else None
    files = (stamped or table).texts(_FILE)
    if files is not None:
        if missing := [name for name in files if name not in by_name]:
            raise DatasetInvalid(f"{(stamped or table).path}: the picture {missing[0][:80]!r} was not found beside it")
        pictures = [by_name[name] for name in files]
    image_times_s = times_s if stamped is None else stamped.times_s()
    if stamped is None and len(pictures) != len(poses):
        raise DatasetInvalid(
            f"{table.path}: it has {len(poses)} poses for {len(pictures)} pictures: name them in a column file, or "
            f"their times in {TIMES}"
        )
    if stamped is None and not delay_ns:
        return pictures, poses, has_pose, times_s
    if times_s is None or image_times_s is None or not np.isfinite(image_times_s).all():
        raise DatasetInvalid(f"{table.path}: poses between its rows need a column time for rows and pictures")
    usable = has_pose & np.isfinite(times_s)
    times_ns, places = np.unique(_nanoseconds(times_s[usable], times_s), return_index=True)
    if not len(places):
        raise DatasetInvalid(f"{table.path}: none of its rows has a pose and a time")
    track = PoseTrack(times_ns, poses[usable][places])
    found, known = track.at(_nanoseconds(image_times_s, times_s) - delay_ns)
    return pictures, found, known, image_times_s


def _nanoseconds(times_s: FloatArray, all_s: FloatArray) -> IntArray:
    return np.round((times_s - np.nanmin(all_s)) * NS_PER_S).astype(np.int64)


def _pictures(folder: Path) -> list[Path]:
    """Those in the folder, or in its one folder of pictures, in the order of the numbers in their names."""
    for place in (folder, *sorted(one for one in folder.iterdir() if one.is_dir())):
        found = [path for path in place.iterdir() if path.suffix.lower() in PICTURES and path.is_file()]
        if found:
            return sorted(found, key=lambda path: [int(one) if one.isdigit() else one for one in _parts(path.name)])
    raise DatasetInvalid(f"{folder}: it holds no pictures ({', '.join(PICTURES)})")


def _parts(name: str) -> list[str]:
    """Words and numbers in turn, so that 9 comes before 10."""
    return re.split(r"(\d+)", name)


def _read_pictures(paths: Sequence[Path]) -> ByteArray:  # [F, rows, columns]
    images: ByteArray | None = None
    for place, path in enumerate(paths):
        found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
        if found is None or found.dtype not in (np.uint8, np.uint16):
            raise DatasetInvalid(f"{path}: it cannot be read as a picture of 8 or 16 bits")
        if found.dtype == np.uint16:
            found = (found // 256).astype(np.uint8)
        if found.ndim == 3:
            found = found[:, :, 2::-1] if found.shape[2] >= 3 else found[:, :, :1]
        grey = grey_frames(found[None], str(path))[0]
        if images is None:
            if grey.size * len(paths) > MAX_PIXEL_BYTES:
                raise DatasetInvalid(f"{path.parent}: its pictures have over {MAX_PIXEL_BYTES >> 30} GiB")
            images = np.empty((len(paths), *grey.shape), np.uint8)
        if grey.shape != images.shape[1:]:
            raise DatasetInvalid(
                f"{path}: it has {grey.shape[1]} x {grey.shape[0]} pixels, {paths[0].name} {images.shape[2]} x "
                f"{images.shape[1]}"
            )
        images[place] = grey
    assert images is not None  # there are paths
    return images

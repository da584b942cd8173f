"""Datasets in the layout of the released trainer: conf.json, images_*.npy, poses_*.npy or .json, and, an addition of
ours, times_*.npy.

conf.json says where the planes are, in centimetres and degrees (`ultragray.exchange.released_config`); poses are in
mm. Rows lie where Sweep puts them, as measured from the image: the stretch of docs/physics.md §3 is for released
checkpoints only.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ultragray.datasets.clocks import delay_note, parse_delay_ns, poses_before
from ultragray.datasets.images import grey_frames
from ultragray.errors import CheckpointInvalid, DatasetInvalid, InvalidArgument, InvalidPose
from ultragray.exchange.poses import frames_with_pose, read_frame_poses
from ultragray.exchange.released_config import ReleasedConfig, probe_keys, read_released_config
from ultragray.files import atomic_path, map_npy, write_whole
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.learn.sweep import ByteArray, Chain, Dataset, IntArray, Link, Sweep, check_frame_poses, frame_list

CONFIG_NAME = "conf.json"


def read_released(path: str | Path, image_delay_ms: str | None = None) -> Dataset:
    """The dataset that a conf.json describes; `path` is that file, or the folder that holds it.

    Images are uint8 or floats in [0, 1], [N, H, W], [N, 1, H, W] or in colour [N, H, W, 3 or 4]; poses [N, 4, 4] or
    [N, 3, 4], probe→tracker, mm; times, which may be missing, [N], s. Where conf.json names no held-out files there are
    no held-out frames. Raises DatasetInvalid, naming the file, the frame and the reason, and InvalidArgument for a
    delay of images without times.
    """
    path, delay_ns = Path(path), parse_delay_ns(image_delay_ms)
    if path.is_dir():
        path = path / CONFIG_NAME
    try:
        config = read_released_config(path)
        probe = config.released_probe
    except CheckpointInvalid as error:
        raise DatasetInvalid(error.detail) from error
    train = _read_part(config, "train", probe)
    has_val = bool({"images_file_val", "poses_file_val"} & set(config.files))
    val = _read_part(config, "val", probe) if has_val else train.select([])
    if delay_ns:
        train, val = _with_delay(train, val, delay_ns, path)
    return Dataset(name=config.dataset_name or path.resolve().parent.name, train=train, val=val)


def require_files_below(config_path: Path, folder: Path) -> None:
    """Raise DatasetInvalid where a conf.json from a stranger names files that are not below `folder`.

    Nothing outside is looked for. What is found here is what `read_released` finds afterwards.
    """
    try:
        config = read_released_config(config_path, within=folder)
    except CheckpointInvalid as error:
        raise DatasetInvalid(error.detail) from error
    for key, named in config.files.items():
        found = config.find(key)
        if found is None or not found.resolve().is_relative_to(folder):
            raise DatasetInvalid(f"{config_path}: {key} names {named[:200]!r}, which is not in the upload")


def _read_part(config: ReleasedConfig, part: str, probe: Probe) -> Sweep:
    images_path, poses_path = (_file(config, f"{kind}_file_{part}") for kind in ("images", "poses"))
    images, (numbers, poses, count) = _read_images(images_path), _read_poses(poses_path)
    if len(images) != count:
        raise DatasetInvalid(f"{images_path} holds {len(images)} images, but {poses_path} {count} poses")
    times_key = f"times_file_{part}"
    times_s = _read_times(_file(config, times_key), count)[numbers] if times_key in config.files else None
    return Sweep.of_recording(
        images=images if len(numbers) == count else images[numbers],
        poses=poses,
        probe=probe,
        frame_numbers=numbers,
        source=str(images_path),
        notes=no_pose_note(numbers, count, poses_path),
        chain=Chain((Link("Probe", "Tracker", "pose", poses_path.name, is_tracked=True),)),
        times_s=times_s,
    )


def _with_delay(train: Sweep, val: Sweep, delay_ns: int, path: Path) -> list[Sweep]:
    """Both parts at the poses of a delay before their times, which are of one clock, taken between those of all frames.

    Frames that then have no pose are left out. Raises InvalidArgument where a part has no times.
    """
    times = [part.times_s for part in (train, val) if part.times_s is not None]
    times_s = np.concatenate(times) if len(times) == 2 else None
    poses, is_known = poses_before(np.concatenate([train.poses, val.poses]), times_s, delay_ns, path)
    found, first = [], 0
    for part in (train, val):
        own = slice(first, first + len(part))
        moved = replace(part, poses=poses[own], notes=(*part.notes, *delay_note(delay_ns)))
        found.append(moved.select(np.flatnonzero(is_known[own])))
        first = own.stop
    return found


def _file(config: ReleasedConfig, key: str) -> Path:
    if key not in config.files:
        raise DatasetInvalid(f"{config.path}: it lacks {key}")
    found = config.find(key)
    if found is None:
        raise DatasetInvalid(f"{config.path}: {key} names {config.files[key][:200]!r}, which was not found")
    return found


def _read_images(path: Path) -> ByteArray:  # [F, H, W]
    try:
        frames = map_npy(path)
    except (OSError, ValueError) as error:
        raise DatasetInvalid(f"{path}: not an array of images that can be read: {error}") from error
    return grey_frames(frames, str(path))


def _read_poses(path: Path) -> tuple[IntArray, FloatArray, int]:  # [F], [F, 4, 4]
    """Numbers of the frames that have a pose, their poses, and the number of all."""
    try:
        poses = read_frame_poses(path)
    except InvalidPose as error:
        raise DatasetInvalid(error.detail) from error
    if poses.dtype.kind not in "fiu" or poses.ndim != 3 or poses.shape[1:] != (4, 4):
        raise DatasetInvalid(
            f"{path}: poses must be numbers [N, 4, 4] or [N, 3, 4], got {poses.dtype} {list(poses.shape)}"
        )
    numbers = np.flatnonzero(frames_with_pose(poses := np.array(poses, np.float64)))
    return numbers, check_frame_poses(poses[numbers], numbers, str(path)), len(poses)


def _read_times(path: Path, count: int) -> FloatArray:  # [F] s
    try:
        times = map_npy(path)
    except (OSError, ValueError) as error:
        raise DatasetInvalid(f"{path}: not an array of times that can be read: {error}") from error
    if times.dtype.kind not in "fiu" or times.shape != (count,):
        raise DatasetInvalid(f"{path}: times must be numbers [{count}], got {times.dtype} {list(times.shape)}")
    times_s = np.array(times, np.float64)
    if len(wrong := np.flatnonzero(~np.isfinite(times_s))):
        raise DatasetInvalid(f"{path}: times must be finite, those of frames {frame_list(wrong)} are not")
    return times_s


def no_pose_note(numbers: IntArray, count: int, path: Path) -> tuple[str, ...]:
    """What a person is told of the frames without a pose."""
    missing = sorted(set(range(count)) - set(numbers.tolist()))
    if not missing:
        return ()
    return (f"frames without a pose in {path.name} were left out: {frame_list(missing)} ({len(missing)} in all)",)


def write_released(dataset: Dataset, folder: str | Path, *, replace: bool = False) -> None:
    """Write the dataset in this layout; conf.json comes last, so that a folder which has it is complete.

    Our reader gives the same dataset back (`Dataset.sha256`) where the planes are whole multiples of 1e-9 mm. Paths in
    conf.json are written as the released trainer expects them, from the folder that holds `data/`. Raises
    InvalidArgument where one of the files already exists, unless `replace` allows it.
    """
    folder = Path(folder)
    parts = [(part, sweep) for part, sweep in (("train", dataset.train), ("val", dataset.val)) if len(sweep)]
    arrays = {
        (kind, part): array
        for part, sweep in parts
        for kind, array in (("images", sweep.images), ("poses", sweep.poses), ("times", sweep.times_s))
        if array is not None
    }
    for file_name in (CONFIG_NAME, *(_array_name(*key) for key in arrays)):
        if (folder / file_name).exists() and not replace:
            raise InvalidArgument(f"{folder / file_name} already exists: choose another folder", field="output")
    keys = probe_keys(dataset.probe)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / CONFIG_NAME).unlink(missing_ok=True)
    name = folder.resolve().name
    document: dict[str, Any] = {}
    for (kind, part), array in arrays.items():
        file_name = _array_name(kind, part)
        with atomic_path(folder / file_name) as temporary, temporary.open("wb") as file:
            np.save(file, array, allow_pickle=False)
        document[f"{kind}_file_{part}"] = f"data/{name}/{file_name}"
    document |= {"result_dir": f"results/{name}", **keys, "_source": dataset.name}
    write_whole(folder / CONFIG_NAME, json.dumps(document, indent=1) + "\n")


def _array_name(kind: str, part: str) -> str:
    return f"{kind}_{part}.npy"

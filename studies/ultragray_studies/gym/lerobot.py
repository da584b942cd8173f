"""LeRobot data sets of episodes: what an agent saw and did, for learning by imitation (the extra `parquet`).

The format is LeRobot's 3.0, frames as PNG files within the tables. A folder holds:

    meta/info.json                             features, their shapes and types, counts
    meta/stats.json                            least, greatest, mean, standard deviation of each feature
    meta/tasks.parquet                         the number of each task in words
    meta/episodes/chunk-000/file-000.parquet   of each episode its tasks, length and rows
    data/chunk-000/file-000.parquet            a row for each step
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ultragray.errors import InvalidArgument
from ultragray.files import write_whole
from ultragray.installation import missing_extra
from ultragray.learn.localization.pixels import read_png
from ultragray.rendering.pixels import png_file

try:
    import pyarrow
    from pyarrow import parquet
except ImportError as error:
    raise missing_extra(error, "a LeRobot data set") from None

VERSION = "v3.0"
IMAGE, STATE, ACTION, REWARD, DONE = (
    "observation.images.bmode",
    "observation.state",
    "action",
    "next.reward",
    "next.done",
)
DATA, EPISODES = (
    "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "meta/episodes/chunk-000/file-000.parquet",
)
FIRST = DATA.format(chunk_index=0, file_index=0)
POSE_NAMES = [*("x", "y", "z"), *(f"r{row}{column}" for row in range(3) for column in range(3))]
ACTION_NAMES = ("lateral", "elevation", "axial", "about_lateral", "about_elevation", "about_axial", "needle")

Floats = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Episode:
    """T steps: what was seen before each action, and what came of it."""

    frames: npt.NDArray[np.uint8]  # [T, H, W]
    poses: Floats  # [T, 12]: as `with_pose` observes them
    actions: Floats  # [T, A]
    rewards: Floats  # [T]
    is_done: bool  # whether the last step reached the goal
    task: str  # in words, such as "Scan to the standard plane."

    def __post_init__(self) -> None:
        lengths = {len(part) for part in (self.frames, self.poses, self.actions, self.rewards)}
        if len(lengths) != 1 or not len(self.frames):
            counts = [len(part) for part in (self.frames, self.poses, self.actions, self.rewards)]
            raise InvalidArgument(f"an episode must have as many frames, poses, actions and rewards, got {counts}")


def rollout(env: Any, act: Callable[[Any, dict[str, Any]], Any], task: str, seed: int | None = None) -> Episode:
    """An episode of an UltragrayEnv that observes poses (`with_pose`), by actions of its observation and infos.

    Raises InvalidArgument where it does not observe them.
    """
    if not env.unwrapped.settings.with_pose:
        raise InvalidArgument("env must observe poses: make it with with_pose=True", field="env")
    observation, info = env.reset(seed=seed)
    steps, is_done, is_over = [], False, False
    while not (is_done or is_over):
        action = np.asarray(act(observation, info), np.float32)
        seen = observation
        observation, reward, is_done, is_over, info = env.step(action)
        steps.append((seen["frame"][..., 0], seen["pose"], action, reward))
    frames, poses, actions, rewards = (np.stack(part) for part in zip(*steps, strict=True))
    return Episode(frames, poses, actions, rewards.astype(np.float32), is_done, task)


def write_lerobot(folder: Path, episodes: Sequence[Episode], *, fps: int = 25, robot: str = "ultrasound probe") -> None:
    """Writes a data set of episodes into a new folder; frames and actions are alike in all of them.

    Raises InvalidArgument where there is none, where shapes differ, where the folder exists, and for an `fps` of 0 or
    less.
    """
    if not (math.isfinite(fps) and fps > 0):
        raise InvalidArgument(f"fps must be greater than 0, got {fps}", field="fps")
    if folder.exists():
        raise InvalidArgument(f"folder must not exist yet, got {str(folder)!r}", field="folder")
    shapes = {(one.frames.shape[1:], one.actions.shape[1:]) for one in episodes}
    if len(shapes) != 1:
        raise InvalidArgument(f"episodes must be some, of frames and actions alike, got {len(shapes)} kinds of them")
    (size, (action_size,)) = shapes.pop()
    tasks = list(dict.fromkeys(one.task for one in episodes))
    lengths = np.array([len(one.frames) for one in episodes])
    ends = lengths.cumsum()
    features: dict[str, dict[str, Any]] = {
        IMAGE: {"dtype": "image", "shape": [*size, 1], "names": ["height", "width", "channels"]},
        STATE: {"dtype": "float32", "shape": [len(POSE_NAMES)], "names": POSE_NAMES},
        ACTION: {"dtype": "float32", "shape": [action_size], "names": list(ACTION_NAMES[:action_size])},
        REWARD: {"dtype": "float32", "shape": [1], "names": None},
        DONE: {"dtype": "bool", "shape": [1], "names": None},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        **{name: {"dtype": "int64", "shape": [1], "names": None} for name in INDICES},
    }
    steps = np.concatenate([np.arange(length) for length in lengths])
    numbers = np.repeat(np.arange(len(episodes)), lengths)
    columns = {
        STATE: np.concatenate([one.poses for one in episodes]).astype(np.float32),
        ACTION: np.concatenate([one.actions for one in episodes]).astype(np.float32),
        REWARD: np.concatenate([one.rewards for one in episodes]).astype(np.float32),
        DONE: np.concatenate(
            [np.arange(1, length + 1) == length * one.is_done for one, length in zip(episodes, lengths, strict=True)]
        ),
        "timestamp": (steps / fps).astype(np.float32),
        **dict(
            zip(
                INDICES,
                (
                    steps,
                    numbers,
                    np.arange(ends[-1]),
                    np.array([tasks.index(episodes[n].task) for n in numbers.tolist()]),
                ),
                strict=True,
            )
        ),
    }
    info = {
        "codebase_version": VERSION,
        "robot_type": robot,
        "total_episodes": len(episodes),
        "total_frames": int(ends[-1]),
        "total_tasks": len(tasks),
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": DATA,
        "video_path": None,
        "features": features,
    }
    for part in (FIRST, EPISODES):
        (folder / part).parent.mkdir(parents=True)
    images = [{"bytes": png_file(frame), "path": None} for frame in _frames(episodes)]
    arrays = {IMAGE: pyarrow.array(images, _IMAGE), **{name: _array(values) for name, values in columns.items()}}
    known = {"info": {"features": {IMAGE: {"_type": "Image"}}}}  # by which datasets' own reader decodes the PNG files
    table = pyarrow.table(arrays).replace_schema_metadata({"huggingface": json.dumps(known)})
    parquet.write_table(table, folder / FIRST)
    parquet.write_table(_task_table(tasks), folder / "meta/tasks.parquet")
    parquet.write_table(_episode_table(episodes, ends), folder / EPISODES)
    stats = {name: _statistics(values.reshape(len(values), -1)) for name, values in columns.items()}
    stats[IMAGE] = _image_statistics(episodes)
    for name, document in (("info", info), ("stats", stats)):
        write_whole(folder / f"meta/{name}.json", json.dumps(document, indent=4))


INDICES = ("frame_index", "episode_index", "index", "task_index")
_IMAGE = pyarrow.struct({"bytes": pyarrow.binary(), "path": pyarrow.string()})


def _frames(episodes: Sequence[Episode]) -> Iterator[npt.NDArray[np.uint8]]:
    for one in episodes:
        yield from one.frames


def _array(values: npt.NDArray[Any]) -> Any:  # [T] or [T, D]
    if values.ndim == 1:
        return pyarrow.array(values)
    flat = pyarrow.array(values.ravel())
    return pyarrow.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _task_table(tasks: Sequence[str]) -> Any:
    """Tasks are the index of a table of pandas, which is how LeRobot reads them."""
    table = pyarrow.table({"task_index": pyarrow.array(range(len(tasks)), pyarrow.int64()), "task": list(tasks)})
    kinds = {"task_index": "int64", "task": "unicode"}
    columns = [
        {
            "name": name,
            "field_name": name,
            "pandas_type": kind,
            "numpy_type": "int64" if kind == "int64" else "object",
            "metadata": None,
        }
        for name, kind in kinds.items()
    ]
    metadata = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    return table.replace_schema_metadata({"pandas": json.dumps(metadata)})


def _episode_table(episodes: Sequence[Episode], ends: npt.NDArray[np.int64]) -> Any:
    nothing = [0] * len(episodes)
    return pyarrow.table(
        {
            "episode_index": list(range(len(episodes))),
            "tasks": [[one.task] for one in episodes],
            "length": [len(one.frames) for one in episodes],
            "data/chunk_index": nothing,
            "data/file_index": nothing,
            "dataset_from_index": [0, *ends[:-1].tolist()],
            "dataset_to_index": ends.tolist(),
            "meta/episodes/chunk_index": nothing,
            "meta/episodes/file_index": nothing,
        }
    )


def _statistics(values: npt.NDArray[Any]) -> dict[str, Any]:  # [T, D]
    numbers = values.astype(np.float64)
    parts = {
        "min": numbers.min(axis=0),
        "max": numbers.max(axis=0),
        "mean": numbers.mean(axis=0),
        "std": numbers.std(axis=0),
    }
    return {**{name: part.tolist() for name, part in parts.items()}, "count": [len(values)]}


def _image_statistics(episodes: Sequence[Episode]) -> dict[str, Any]:
    """Of shares of white, for the one channel, [1, 1, 1]."""
    grey = _statistics(np.concatenate([one.frames.reshape(-1, 1) for one in episodes]) / 255.0)
    count = [sum(len(one.frames) for one in episodes)]
    return {**{name: [[[part[0]]]] for name, part in grey.items()}, "count": count}


def read_lerobot(folder: Path) -> list[Episode]:
    """The episodes of a data set in a folder, of LeRobot 3.0 with images within its tables, such as write_lerobot()'s.

    Raises InvalidArgument for another version, for videos, and where a feature that an Episode has is missing.
    """
    try:
        info: Mapping[str, Any] = json.loads((folder / "meta/info.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InvalidArgument(f"{folder} holds no LeRobot data set: {error}", field="folder") from None
    if info.get("codebase_version") != VERSION:
        version = info.get("codebase_version")
        raise InvalidArgument(f"a LeRobot data set must be of version {VERSION}, got {version!r}", field="folder")
    wanted = {IMAGE: "image", STATE: "float32", ACTION: "float32", REWARD: "float32", DONE: "bool"}
    for name, kind in wanted.items():
        if (dtype := info["features"].get(name, {}).get("dtype")) != kind:
            raise InvalidArgument(f"the feature {name} must be {kind}, got {dtype}", field="folder")
    tasks = {row["task_index"]: row["task"] for row in parquet.read_table(folder / "meta/tasks.parquet").to_pylist()}
    table = pyarrow.concat_tables(parquet.read_table(path) for path in sorted((folder / "data").glob("*/*.parquet")))
    numbers = table["episode_index"].to_numpy()
    episodes = []
    for number in np.unique(numbers):
        part = table.filter(pyarrow.array(numbers == number))
        states, actions = (np.array(part[name].to_pylist(), np.float32) for name in (STATE, ACTION))
        episodes.append(
            Episode(
                frames=np.stack([read_png(image["bytes"]) for image in part[IMAGE].to_pylist()]),
                poses=states,
                actions=actions,
                rewards=part[REWARD].to_numpy(),
                is_done=bool(part[DONE][-1].as_py()),
                task=tasks[part["task_index"][0].as_py()],
            )
        )
    return episodes

"""The folder of a comparison, in which one that was killed goes on.

run.json                     which comparison it is: dataset, budget, seed; and the equal time once it is known
NAME/                        what the fit of a method continues from, and its model
NAME/result.json             its row, once it is measured
NAME/frames.npy              uint8 [F, H, W], the held-out frames that it expects
"""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ultragray.errors import TrainingStateInvalid
from ultragray.files import map_npy, write_whole
from ultragray.learn.sweep import ByteArray, Dataset
from ultragray.rendering.pixels import to_uint8
from ultragray_studies.comparison.result import FORMAT_VERSION, MethodResult
from ultragray_studies.methods.method import FrameArray

RUN_FILE, METHOD_FILE, FRAMES_FILE = "run.json", "result.json", "frames.npy"


@dataclass(frozen=True)
class Place:
    """A folder, and which comparison it holds."""

    folder: Path
    comparison: dict[str, Any]

    @classmethod
    def of(cls, folder: Path, dataset: Dataset, *, budget: str, times: float, seed: int) -> Place:
        """The folder, made where it is not there. Raises TrainingStateInvalid where it holds another comparison."""
        own = {
            "format_version": FORMAT_VERSION,
            "dataset": dataset.sha256,
            "budget": budget,
            "times": times,
            "seed": seed,
        }
        place = cls(folder, own)
        folder.mkdir(parents=True, exist_ok=True)
        found = place.read()
        for name, value in own.items():
            if found and found.get(name) != value:
                raise TrainingStateInvalid(
                    f"{folder}: it holds a comparison with {name} {found.get(name)}, this one has {value}; "
                    "give another folder"
                )
        if not found:
            place.write({})
        return place

    def read(self) -> dict[str, Any]:
        """What is known of the comparison; empty before it began."""
        path = self.folder / RUN_FILE
        if not path.exists():
            return {}
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise TrainingStateInvalid(f"{path}: not the state of a comparison: {error}") from error
        if not isinstance(document, dict) or not document:
            raise TrainingStateInvalid(f"{path}: not the state of a comparison")
        return document

    def write(self, known: dict[str, Any]) -> None:
        """Keeps what is known beside which comparison it is."""
        write_whole(self.folder / RUN_FILE, json.dumps({**self.comparison, **known}, indent=1) + "\n")

    def of_method(self, name: str) -> Path:
        """The folder of a method's fit."""
        folder = self.folder / name
        folder.mkdir(exist_ok=True)
        return folder

    def result(self, name: str) -> MethodResult | None:
        """The row of a method; None where it is not measured yet. Raises TrainingStateInvalid for a damaged one."""
        path = self.folder / name / METHOD_FILE
        if not path.exists():
            return None
        try:
            return MethodResult.from_dict(json.loads(path.read_text(encoding="utf-8")))
        except (ValueError, TypeError, LookupError) as error:
            raise TrainingStateInvalid(f"{path}: not a result that can be read: {error!r}") from error

    def write_result(self, result: MethodResult, frames: FrameArray) -> None:  # [F, H, W] in [0, 1]
        """The frames first: a row without them would count as done."""
        array = io.BytesIO()
        np.save(array, to_uint8(frames))
        write_whole(self.folder / result.name / FRAMES_FILE, array.getvalue())
        write_whole(self.folder / result.name / METHOD_FILE, json.dumps(result.to_dict()) + "\n")


def frames_of(folder: Path, name: str) -> ByteArray:  # [F, H, W]
    """The frames that a method of the comparison in a folder expects. Raises TrainingStateInvalid."""
    path = folder / name / FRAMES_FILE
    try:
        return map_npy(path)
    except (OSError, ValueError) as error:
        raise TrainingStateInvalid(f"{path}: not frames that can be read: {error}") from error

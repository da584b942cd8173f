"""A comparison: each method is fitted within the same budget and measured on the same held-out frames.

One that was killed goes on in its folder:

run.json                     which comparison it is: dataset, budget, seed; and the equal time once it is known
NAME/                        what the fit of a method continues from, and its model
NAME/result.json             its row, once it is measured
NAME/frames.npy              uint8 [F, H, W], the held-out frames that it expects
"""

from __future__ import annotations

import io
import json
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ultragray.errors import TrainingDiverged, TrainingStateInvalid, UltragrayError
from ultragray.files import map_npy, write_whole
from ultragray.installation import __version__
from ultragray.learn.evaluation.methods import BudgetKind, ComparisonSettings
from ultragray.learn.evaluation.scoring import evaluate_frames, require_frames
from ultragray.learn.report.tables import DatasetFacts
from ultragray.learn.sweep import ByteArray, Dataset, Distances, Sweep, spread_places
from ultragray.learn.training.memory import machine_in_words, training_device
from ultragray.rendering.pixels import to_uint8
from ultragray_studies.comparison.result import FORMAT_VERSION, Comparison, MethodResult
from ultragray_studies.methods.gaussians import SceneMethod
from ultragray_studies.methods.method import Budget, FitProgress, FitRun, Fitted, FrameArray, Method, Pace, Paces

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


# A comparison: each method is fitted within the same budget and measured on the same held-out frames.


SCENE = SceneMethod.name
EQUAL_TIME = "equal time"  # among the paces: the seconds of the scene
TIMED_FRAMES = 5


@dataclass(frozen=True)
class ComparisonProgress:
    """The state of a comparison. `fit` is None before the first step of a method, and where there are none."""

    method: str
    number: int  # of this method, from 1
    of: int
    fit: FitProgress | None


def compare_methods(
    dataset: Dataset,
    methods: Mapping[str, Method],
    settings: ComparisonSettings,
    *,
    folder: Path,
    device: str = "cpu",
    paces: Paces | None = None,
    report: Callable[[ComparisonProgress], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Comparison | None:
    """Compares methods by name; None where it was told to stop. The same call on the same folder goes on.

    `paces` are `default_paces` unless given. Raises DatasetInvalid where no frames are held out, BackendUnavailable,
    and TrainingStateInvalid for a folder of another comparison.
    """
    require_frames(dataset.val)
    training_device(device, "auto")
    paces = default_paces(dataset, device) if paces is None else paces
    place = Place.of(folder, dataset, budget=settings.budget, times=settings.times, seed=settings.seed)
    kind = BudgetKind(settings.budget)
    seconds: float | None = place.read().get("budget_s")
    asked = set(methods)
    needs_time = kind is BudgetKind.EQUAL and any(map(_learns_within_a_time, methods.values()))
    if needs_time:
        if seconds is None and (pace := paces.known(EQUAL_TIME)) is not None:
            seconds = pace.start_s
        if SCENE in methods or seconds is None:
            methods = {SCENE: SceneMethod(), **methods}
    run = FitRun(device=device, seed=settings.seed, should_stop=should_stop)
    results = []
    for number, (name, method) in enumerate(methods.items(), 1):
        if should_stop is not None and should_stop():
            return None
        result: MethodResult | None
        if _learns_within_a_time(method) and kind is BudgetKind.EQUAL and seconds is None:
            result = _failed(name, method, device, "there is no equal time, since the scene failed")
        else:
            own_s = seconds if seconds is None or name == SCENE else seconds * settings.times
            follow = _follower(report, name, number, len(methods))
            result = _measured(name, method, dataset, Budget(kind, own_s, paces), replace(run, report=follow), place)
        if result is None:
            return None
        if needs_time and name == SCENE and result.failure is None and seconds is None:
            seconds = result.seconds
            paces.keep(EQUAL_TIME, Pace(seconds, 0.0))
        if needs_time and seconds is not None:
            place.write({"budget_s": seconds})
        if name in asked:  # the scene may have been fitted for its time only
            results.append(result)
    return Comparison(
        dataset=DatasetFacts.of(dataset),
        machine="; ".join(dict.fromkeys(one.machine for one in results)),
        budget=settings.budget,
        budget_s=seconds if needs_time else None,
        times=settings.times,
        seed=settings.seed,
        distances=Distances.of(dataset),
        results=tuple(results),
    )


def default_paces(dataset: Dataset, device: str = "cpu") -> Paces:
    """What earlier comparisons of this dataset on this machine measured, in the user's folder of caches."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    surroundings = {
        "version": __version__,
        "machine": machine_in_words(device),
        "device": device,
        "dataset": dataset.sha256,
    }
    return Paces(cache / "ultragray" / "paces.json", surroundings)


def _learns_within_a_time(method: Method) -> bool:
    """Whether an equal time says how many steps it takes. The scene's preset has its own number of steps."""
    return not isinstance(method, SceneMethod) and method.describe().published_steps is not None


def _follower(
    report: Callable[[ComparisonProgress], None] | None, name: str, number: int, of: int
) -> Callable[[FitProgress | None], None]:
    def follow(fit: FitProgress | None) -> None:
        if report is not None:
            report(ComparisonProgress(name, number, of, fit))

    follow(None)
    return follow


def _measured(
    name: str, method: Method, dataset: Dataset, budget: Budget, run: FitRun, place: Place
) -> MethodResult | None:
    """The row of a method, which is fitted unless it has one already; None where it was told to stop.

    A failure is a row too, but is not kept: the same comparison tries the method again.
    """
    if (known := place.result(name)) is not None:
        return known
    try:
        fitted = method.fit(dataset, budget, replace(run, folder=place.of_method(name)))
        if fitted is None:
            return None
        result, frames = measure(name, method, fitted, dataset.val, machine_in_words(run.device))
    except UltragrayError as error:
        return _failed(name, method, run.device, str(error))
    except (MemoryError, RuntimeError) as error:
        if not _is_out_of_memory(error):
            raise
        return _failed(name, method, run.device, "the memory of this machine did not suffice")
    place.write_result(result, frames)
    return result


def _failed(name: str, method: Method, device: str, reason: str) -> MethodResult:
    return MethodResult(name, method.describe(), machine_in_words(device), failure=reason)


def _is_out_of_memory(error: Exception) -> bool:
    """Also on the CPU, where torch raises a plain RuntimeError."""
    return isinstance(error, (MemoryError, torch.OutOfMemoryError)) or "DefaultCPUAllocator" in str(error)


def measure(name: str, method: Method, fitted: Fitted, sweep: Sweep, machine: str) -> tuple[MethodResult, FrameArray]:
    """The row of a fitted method and the frames [F, H, W] that it expects, clipped to [0, 1].

    Raises TrainingDiverged where they are not finite.
    """
    frames = fitted.render(sweep.probe, sweep.poses, sweep.height, sweep.width)
    if not np.isfinite(frames).all():
        raise TrainingDiverged("frames that it expects are not finite")
    frames = np.clip(frames, 0.0, 1.0)
    cost = fitted.cost
    result = MethodResult(
        name=name,
        description=method.describe(),
        machine=machine,
        steps=cost.steps,
        of_steps=cost.of_steps,
        seconds=cost.seconds,
        frame_ms=_frame_ms(fitted, sweep),
        model_bytes=cost.model_bytes,
        evaluation=evaluate_frames(frames, sweep),
    )
    return result, frames


def _frame_ms(fitted: Fitted, sweep: Sweep) -> float:
    """The median time of one frame rendered alone, after the first, which may build what later ones use."""
    chosen = sweep.poses[spread_places(len(sweep), TIMED_FRAMES)]
    poses = [chosen[place % len(chosen)][None] for place in range(TIMED_FRAMES + 1)]
    seconds = []
    for pose in poses:
        began_s = time.perf_counter()
        fitted.render(sweep.probe, pose, sweep.height, sweep.width)
        seconds.append(time.perf_counter() - began_s)
    return 1000.0 * float(np.median(seconds[1:]))

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
from ultragray.learn.training.agreement import agreed_path
from ultragray.learn.training.memory import machine_in_words, training_device
from ultragray.rendering.pixels import to_uint8
from ultragray_studies.comparison.result import FORMAT_VERSION, Comparison, MethodResult
from ultragray_studies.methods.gaussians import SceneMethod
from ultragray_studies.methods.method import Budget, FitProgress, FitRun, Fitted, FrameArray, Method, Pace, Paces

RUN_FILE, METHOD_FILE, FRAMES_FILE = "run.json", "result.json", "frames.npy"
SCENE = SceneMethod.name
EQUAL_TIME = "equal time"  # among the paces: the seconds of the scene
TIMED_FRAMES = 5


class Place:
    """The folder of a comparison."""

    def __init__(self, folder: Path, **comparison: object) -> None:
        """Make it where it is not there. Raises TrainingStateInvalid where it holds another comparison."""
        self.folder, self._comparison = folder, comparison
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / RUN_FILE
        if not path.exists():
            self.budget_s: float | None = None
            self.keep_budget(None)
            return
        try:
            document = dict(json.loads(path.read_text(encoding="utf-8")))
        except (ValueError, TypeError) as error:
            raise TrainingStateInvalid(f"{path}: not the state of a comparison: {error}") from error
        for name, value in comparison.items():
            if document.get(name) != value:
                raise TrainingStateInvalid(
                    f"{folder}: it holds a comparison with {name} {document.get(name)}, this one has {value}; "
                    "give another folder"
                )
        self.budget_s = document.get("budget_s")

    def keep_budget(self, seconds: float | None) -> None:
        """Keep the equal time beside which comparison it is."""
        self.budget_s = seconds
        known = self._comparison if seconds is None else {**self._comparison, "budget_s": seconds}
        write_whole(self.folder / RUN_FILE, json.dumps(known, indent=1) + "\n")

    def result(self, name: str) -> MethodResult | None:
        """The row of a method; None where it is not measured yet. Raises TrainingStateInvalid for a damaged one."""
        path = self.folder / name / METHOD_FILE
        if not path.exists():
            return None
        try:
            return MethodResult.from_dict(json.loads(path.read_text(encoding="utf-8")))
        except (ValueError, TypeError, LookupError) as error:
            raise TrainingStateInvalid(f"{path}: not a result that can be read: {error!r}") from error

    def keep_result(self, result: MethodResult, frames: FrameArray) -> None:  # [F, H, W] in [0, 1]
        """Write the frames first: a row without them would count as done."""
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
    report: Callable[[ComparisonProgress], None] = lambda state: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Comparison | None:
    """Compares methods by name; None where it was told to stop. The same call on the same folder goes on.

    `paces` are `default_paces` unless given. Raises DatasetInvalid where no frames are held out, BackendUnavailable,
    and TrainingStateInvalid for a folder of another comparison.
    """
    require_frames(dataset.val)
    training_device(device, "auto")
    paces = default_paces(dataset, device) if paces is None else paces
    shared: dict[str, Any] = {"budget": settings.budget, "times": settings.times, "seed": settings.seed}
    place = Place(folder, format_version=FORMAT_VERSION, dataset=dataset.sha256, **shared)
    kind, names = BudgetKind(settings.budget), set(methods)
    needs_time = kind is BudgetKind.EQUAL and any(map(_learns_within_a_time, methods.values()))
    seconds = place.budget_s
    if needs_time:
        if seconds is None and (pace := paces.known(EQUAL_TIME)) is not None:
            seconds = pace.start_s
        if SCENE in methods or seconds is None:
            methods = {SCENE: SceneMethod(), **methods}
    results = []
    path = agreed_path(dataset)
    placed = dataset if path is None else path.of(dataset)
    for number, (name, method) in enumerate(methods.items(), 1):
        if should_stop():
            return None

        def follow(fit: FitProgress | None, name: str = name, number: int = number) -> None:
            report(ComparisonProgress(name, number, len(methods), fit))

        if needs_time and seconds is None and _learns_within_a_time(method):
            reason = "there is no equal time, since the scene failed"
            result: MethodResult | None = _failed(name, method, device, reason)
        else:
            follow(None)
            own_s = seconds if seconds is None or name == SCENE else seconds * settings.times
            run = FitRun(folder / name, device, settings.seed, follow, should_stop)
            result = _measured(name, method, dataset, placed, Budget(kind, own_s, paces), run, place)
        if result is None:
            return None
        if needs_time and name == SCENE and result.failure is None and seconds is None:
            seconds = result.cost.seconds
            paces.keep(EQUAL_TIME, Pace(seconds, 0.0))
        if needs_time and seconds != place.budget_s:
            place.keep_budget(seconds)
        if name in names:  # the scene may have been fitted for its time only
            results.append(result)
    return Comparison(
        dataset=DatasetFacts.of(dataset),
        machine="; ".join(dict.fromkeys(one.machine for one in results)),
        **shared,
        budget_s=seconds if needs_time else None,
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


def _measured(
    name: str, method: Method, dataset: Dataset, placed: Dataset, budget: Budget, run: FitRun, place: Place
) -> MethodResult | None:
    """The row of a method, which is fitted unless it has one already; None where it was told to stop.

    `placed` is the dataset on the path that neighbouring frames agree with, itself where that is as tracked.

    A failure is a row too, but is not kept: the same comparison tries the method again.
    """
    if (known := place.result(name)) is not None:
        return known
    try:
        (place.folder / name).mkdir(exist_ok=True)
        fitted = method.fit(dataset, budget, run)
        if fitted is None:
            return None
        result, frames = measure(name, method, fitted, dataset.val, machine_in_words(run.device))
        on_path = method.predict_on_path(dataset, placed, fitted) if placed is not dataset else None
        if on_path is not None:
            result = replace(result, on_path=evaluate_frames(on_path, dataset.val).mean)
    except UltragrayError as error:
        return _failed(name, method, run.device, str(error))
    except (MemoryError, RuntimeError) as error:  # of memory on the CPU torch raises a plain RuntimeError
        is_of_memory = isinstance(error, (MemoryError, torch.OutOfMemoryError))
        if not is_of_memory and "DefaultCPUAllocator" not in str(error):
            raise
        return _failed(name, method, run.device, "the memory of this machine did not suffice")
    place.keep_result(result, frames)
    return result


def _failed(name: str, method: Method, device: str, reason: str) -> MethodResult:
    return MethodResult(name, method.describe(), machine_in_words(device), failure=reason)


def measure(name: str, method: Method, fitted: Fitted, sweep: Sweep, machine: str) -> tuple[MethodResult, FrameArray]:
    """The row of a fitted method and the frames [F, H, W] that it expects, clipped to [0, 1].

    Raises TrainingDiverged where they are not finite.
    """
    frames = fitted.predict(sweep)
    if not np.isfinite(frames).all():
        raise TrainingDiverged("frames that it expects are not finite")
    frames = np.clip(frames, 0.0, 1.0)
    evaluation = evaluate_frames(frames, sweep)
    frame_ms = _frame_ms(fitted, sweep)
    return MethodResult(name, method.describe(), machine, fitted.cost, frame_ms, evaluation), frames


def _frame_ms(fitted: Fitted, sweep: Sweep) -> float:
    """The median time of one frame rendered alone, after the first, which may build what later ones use."""
    chosen = spread_places(len(sweep), TIMED_FRAMES)
    seconds = []
    for place in range(TIMED_FRAMES + 1):
        began_s = time.perf_counter()
        fitted.predict(sweep.select(chosen[[place % len(chosen)]]))
        seconds.append(time.perf_counter() - began_s)
    return 1000.0 * float(np.median(seconds[1:]))

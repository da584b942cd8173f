"""Methods that learn by steps: their loop with budget, checkpoints and progress.

It runs without subnormal numbers, those below 1.2e-38, for which a CPU takes a hundred times as long: a beam that fades
along its scan line, and the gradients that go back along it, soon consist of them.
"""

from __future__ import annotations

import json
import math
import time
from abc import abstractmethod
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from ultragray.errors import MemoryExceeded, TrainingDiverged, TrainingStateInvalid
from ultragray.files import write_whole
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.learn.sweep import Dataset
from ultragray.learn.training.memory import training_device
from ultragray_studies.methods.method import Budget, Cost, FitProgress, FitRun, Fitted, FrameArray, Method, Pace

T = TypeVar("T")


def without_subnormals(work: Callable[[], T]) -> T:
    """What `work` returns, or raises, with subnormal numbers taken for 0 by all threads of torch that it uses.

    The setting belongs to a thread, and the helpers of torch inherit it from the thread that they are made for. So
    `work` runs in a thread of its own, which gets new ones. (Graphics processors take no longer for subnormals.)
    """
    with ThreadPoolExecutor(1, "no-subnormals", torch.set_flush_denormal, (True,)) as thread:
        return thread.submit(work).result()


# Learned methods: the loop of steps that all of them share, with checkpoints, and the timing of an equal budget.
#
# A method says how its learner begins and what the loss of a step is. Everything that later steps depend on is in the
# learner's module, its optimisers and its generator: a fit that is killed ends in the model of an undisturbed one.


STATE_FILE, MODEL_FILE = "fit.safetensors", "model.safetensors"
METADATA_KEY = "ultragray-method"
WARM_UP_STEPS, TIMED_S, LEAST_TIMED_STEPS = 2, 2.0, 3


class Learner:
    """One fit. A subclass makes `module`, `optimizers` and what else it needs, and says `loss` and `frame`."""

    module: nn.Module  # all that is learned; its state_dict is the model
    optimizers: Mapping[str, torch.optim.Optimizer]

    def __init__(self, dataset: Dataset, seed: int, device: torch.device) -> None:
        self.dataset, self.device = dataset, device
        self.generator = torch.Generator().manual_seed(seed)  # on the CPU: the same draws on every device
        self.images = torch.tensor(dataset.train.images, device=device)  # [F, H, W] uint8

    def image(self, place: int) -> Tensor:  # [H, W] in [0, 1]
        """A training frame."""
        return self.images[place].float().div_(255.0)

    @abstractmethod
    def loss(self, step: int, steps: int) -> Tensor:
        """The loss of step `step` (from 0) of `steps`, a scalar with gradients; may set rates before."""

    @abstractmethod
    def frame(self, probe: Probe, pose: FloatArray, height: int, width: int) -> Tensor:
        """The frame [H, W] expected at a pose [4, 4] (mm, probe→tracker)."""

    def after_step(self, step: int, steps: int) -> None:
        """What is due after step `step` (from 0): nothing, unless a method says otherwise."""

    def take_step(self, step: int, steps: int) -> float:
        """One step; returns its loss. Raises TrainingDiverged where that is not finite."""
        for optimizer in self.optimizers.values():
            optimizer.zero_grad(set_to_none=True)
        loss = self.loss(step, steps)
        loss.backward()  # type: ignore[no-untyped-call]
        for optimizer in self.optimizers.values():
            optimizer.step()
        self.after_step(step, steps)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise TrainingDiverged(f"the fit diverged in step {step + 1:,}: the loss is {value}")
        return value

    def model(self) -> dict[str, Tensor]:
        """What rendering needs."""
        return dict(self.module.state_dict())

    def state(self) -> dict[str, Tensor]:
        """What the next step depends on."""
        tensors = {f"model.{name}": tensor for name, tensor in self.model().items()}
        for name, optimizer in self.optimizers.items():
            for place, of in optimizer.state_dict()["state"].items():
                tensors |= {f"optimizer.{name}.{place}.{key}": torch.as_tensor(value) for key, value in of.items()}
        return {**tensors, "generator": self.generator.get_state()}

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Inverse of `state`. Raises KeyError, RuntimeError or ValueError where that is another learner's."""
        self.load_model(_under("model.", state))
        for name, optimizer in self.optimizers.items():
            document = optimizer.state_dict()
            document["state"] = {}
            for key, tensor in _under(f"optimizer.{name}.", state).items():
                place, _, moment = key.partition(".")
                document["state"].setdefault(int(place), {})[moment] = tensor
            optimizer.load_state_dict(document)
        self.generator.set_state(state["generator"])

    def load_model(self, tensors: Mapping[str, Tensor]) -> None:
        self.module.load_state_dict(dict(tensors))

    def render(self, probe: Probe, poses: FloatArray, height: int, width: int) -> FrameArray:  # [C, H, W]
        with torch.no_grad():
            exact = check_poses(poses) if len(poses) else poses
            frames = [self.frame(probe, pose, height, width).detach().cpu() for pose in exact]
        return torch.stack(frames).float().numpy() if frames else np.zeros((0, height, width), np.float32)


@dataclass(frozen=True, eq=False)
class Learned(Fitted):
    """A learner that has taken all its steps."""

    learner: Learner
    cost: Cost

    def render(self, probe: Probe, poses: FloatArray, height: int, width: int) -> FrameArray:
        return without_subnormals(lambda: self.learner.render(probe, poses, height, width))


class LearnedMethod(Method):
    """A method that learns by steps of gradient descent."""

    @abstractmethod
    def learner(self, dataset: Dataset, budget: Budget, seed: int, device: torch.device) -> Learner:
        """A learner before its first step."""

    def published_steps(self, dataset: Dataset) -> int:
        """The steps of the author's recipe on so many frames."""
        published = self.describe().published_steps
        assert published is not None
        return published

    def fit(self, dataset: Dataset, budget: Budget, run: FitRun | None = None) -> Learned | None:
        run = run or FitRun()
        device = training_device(run.device, "auto")
        try:
            return without_subnormals(lambda: self._fit(dataset, budget, run, device))
        except torch.OutOfMemoryError as error:
            raise MemoryExceeded(f"the memory of {device} did not suffice for {self.name}") from error

    def _fit(self, dataset: Dataset, budget: Budget, run: FitRun, device: torch.device) -> Learned | None:
        def begin() -> Learner:
            return self.learner(dataset, budget, run.seed, device)

        began_s = time.perf_counter()
        learner, published = begin(), self.published_steps(dataset)
        saved = _Saved(run.folder, {"method": self.name, "dataset_sha256": dataset.sha256, "seed": run.seed})
        done, steps, elapsed_s = saved.read(learner)
        if not steps:
            elapsed_s = start_s = time.perf_counter() - began_s
            steps = budget.steps(
                self.name, published, lambda: Pace(start_s, _seconds_of_step(begin()), is_confirmed=False)
            )
        saved_at = time.monotonic()
        while done < steps:
            step_s = -time.perf_counter()
            loss = learner.take_step(done, steps)
            step_s += time.perf_counter()
            done, elapsed_s = done + 1, elapsed_s + step_s
            run.report(FitProgress(done, steps, loss, (steps - done) * elapsed_s / done))
            stop = run.should_stop() and done < steps
            if stop or time.monotonic() - saved_at >= run.checkpoint_interval_s:
                saved.write(STATE_FILE, learner.state(), done, steps, elapsed_s)
                saved_at = time.monotonic()
            if stop:
                return None
        pace = budget.shown_pace(self.name, steps, elapsed_s)
        model = learner.model()
        if pace is None and saved.folder is not None and not (saved.folder / MODEL_FILE).exists():
            saved.write(MODEL_FILE, model, steps, steps, elapsed_s)
        if saved.folder is not None:  # the model is in its place, or the fit begins anew
            (saved.folder / STATE_FILE).unlink(missing_ok=True)
        if pace is not None:
            budget.paces.keep(self.name, pace)
            return self._fit(dataset, budget, run, device)
        budget.paces.confirm(self.name)
        size = sum(tensor.numel() * tensor.element_size() for tensor in model.values())
        return Learned(learner, Cost(elapsed_s, steps, published, size))


def _seconds_of_step(learner: Learner) -> float:
    """The time of a step, by some steps of a learner that is thrown away; the middle one, as others use the machine."""
    for step in range(WARM_UP_STEPS):
        learner.take_step(step, 1_000)
    seconds: list[float] = []
    while len(seconds) < LEAST_TIMED_STEPS or sum(seconds) < TIMED_S:
        began_s = time.perf_counter()
        learner.take_step(WARM_UP_STEPS + len(seconds), 1_000)
        seconds.append(time.perf_counter() - began_s)
    return float(np.median(seconds))


@dataclass(frozen=True)
class _Saved:
    """The files of a fit, in a folder or nowhere."""

    folder: Path | None
    fit: Mapping[str, object]  # which it is

    def read(self, learner: Learner) -> tuple[int, int, float]:
        """Steps done, steps, and seconds of what is there; zeros where nothing is. Raises TrainingStateInvalid."""
        for name in (MODEL_FILE, STATE_FILE):
            if self.folder is None or not (path := self.folder / name).exists():
                continue
            try:
                with safe_open(path, framework="pt") as bundle:
                    header = json.loads((bundle.metadata() or {})[METADATA_KEY])
                    tensors = {key: bundle.get_tensor(key) for key in bundle.keys()}  # noqa: SIM118
                if {key: header[key] for key in self.fit} != self.fit:
                    raise TrainingStateInvalid(
                        f"{path}: it belongs to another fit: {header['method']} with seed {header['seed']} of the "
                        f"dataset {header['dataset_sha256'][:12]}…"
                    )
                (learner.load_model if name == MODEL_FILE else learner.load)(tensors)
                return int(header["step"]), int(header["steps"]), float(header["elapsed_s"])
            except (SafetensorError, OSError, ValueError, TypeError, LookupError, RuntimeError) as error:
                raise TrainingStateInvalid(f"{path}: not a fit that can be read: {error}") from error
        return 0, 0, 0.0

    def write(self, name: str, tensors: Mapping[str, Tensor], step: int, steps: int, elapsed_s: float) -> None:
        if self.folder is None:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        header = json.dumps({**self.fit, "step": step, "steps": steps, "elapsed_s": elapsed_s}, sort_keys=True)
        stored = {key: tensor.detach().cpu().contiguous().clone() for key, tensor in tensors.items()}
        write_whole(self.folder / name, save(stored, metadata={METADATA_KEY: header}))


def _under(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}

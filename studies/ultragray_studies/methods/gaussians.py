"""This project's scene as a method: 3D Gaussians with the physics-based ray model of UltraG-Ray."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from ultragray.files import write_whole
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.learn.evaluation.methods import BudgetKind
from ultragray.learn.sweep import Dataset
from ultragray.learn.training import Progress, TrainingConfig, train
from ultragray.learn.training.checkpointing import read_checkpoint_header
from ultragray.learn.training.memory import training_device
from ultragray.learn.training.poses import held_out_on_path
from ultragray.learn.training.trainer import CHECKPOINT_FILE
from ultragray.rendering.frames import render
from ultragray.scene.gaussians import GaussianScene
from ultragray_studies.methods.method import (
    Budget,
    Cost,
    Description,
    FitProgress,
    FitRun,
    Fitted,
    FrameArray,
    Method,
)

SCENE_FILE = "scene.ugr"
SECONDS_FILE = "seconds.json"  # that the fit took in all


class _OfScene(Method):
    """Either of the two below."""

    def predict_on_path(self, dataset: Dataset, placed: Dataset, fitted: Fitted) -> FrameArray | None:
        assert isinstance(fitted, SceneFit)
        held_out = held_out_on_path(dataset, fitted.scene)
        return None if held_out is None else replace(fitted, scene=fitted.scene.at_rest()).predict(held_out)


@dataclass(frozen=True)
class SceneMethod(_OfScene):
    """A training with this project's trainer. An equal time is what its preset `fast` takes: it has no other budget."""

    name: str = "scene"
    title: str = "UltraG-Ray (this project)"
    settings: dict[str, object] = field(default_factory=dict)  # instead of the preset's

    def describe(self) -> Description:
        return Description(
            title=self.title,
            source="UltraG-Ray, MIDL 2026; docs/physics.md",
            summary="3D Gaussians that reflect and absorb: B = E T, T the product of what each leaves of the beam.",
            equations=("E = (1 - exp(-S)) sum(I w) / S", "T = prod(1 - alpha (1 - tau))", "B = E T"),
            choices=("Equal time: the preset fast, whose time it defines. Author's recipe: the preset paper.",),
            published_steps=TrainingConfig.preset("paper").steps,
        )

    def config(self, budget: Budget, seed: int) -> TrainingConfig:
        preset = {BudgetKind.EQUAL: "fast", BudgetKind.AUTHOR: "paper"}[budget.kind]
        return TrainingConfig.preset(preset, **{"seed": seed, **self.settings, "confidence": False})

    def fit(self, dataset: Dataset, budget: Budget, run: FitRun | None = None) -> SceneFit | None:
        run = run or FitRun()
        folder = run.folder
        if folder is not None and (folder / SCENE_FILE).exists():
            return self._fitted(GaussianScene.load(folder / SCENE_FILE), folder, run.device)
        seconds = -time.perf_counter()

        def follow(progress: Progress) -> None:
            run.report(FitProgress(progress.step, progress.steps, progress.loss, progress.seconds_left))

        resume = folder is not None and (folder / CHECKPOINT_FILE).exists()
        if resume:
            assert folder is not None
            seconds += read_checkpoint_header(folder / CHECKPOINT_FILE).elapsed_s  # of the run that was killed
        scene = train(
            dataset,  # with the frames that are held out: their poses are part of the path
            self.config(budget, run.seed),
            folder=folder,
            resume=resume,
            report=follow,
            should_stop=run.should_stop,
            device=run.device,
            checkpoint_interval_s=run.checkpoint_interval_s,
        )
        if scene.info.training["step"] < scene.info.training["steps"]:
            return None
        seconds += time.perf_counter()
        if folder is None:
            cost = self._cost(scene, seconds, len(scene.to_bytes()))
            return SceneFit(scene.to(training_device(run.device, "auto")), cost)
        write_whole(folder / SECONDS_FILE, json.dumps(seconds) + "\n")
        scene.save(folder / SCENE_FILE)
        (folder / CHECKPOINT_FILE).unlink(missing_ok=True)
        return self._fitted(scene, folder, run.device)

    def _fitted(self, scene: GaussianScene, folder: Path, device: str) -> SceneFit:
        seconds = float(json.loads((folder / SECONDS_FILE).read_text(encoding="utf-8")))
        cost = self._cost(scene, seconds, (folder / SCENE_FILE).stat().st_size)
        return SceneFit(scene.to(training_device(device, "auto")), cost)

    def _cost(self, scene: GaussianScene, seconds: float, size: int) -> Cost:
        return Cost(seconds, int(scene.info.training["steps"]), self.describe().published_steps, size)


@dataclass(frozen=True, eq=False)
class GivenScene(_OfScene):
    """A scene that is there already, to be measured beside others."""

    scene: GaussianScene
    seconds: float = 0.0  # that its training took, where that is known
    name: str = SceneMethod.name
    title: str = "this scene"

    def describe(self) -> Description:
        return replace(SceneMethod().describe(), title=self.title, choices=(), published_steps=None)

    def fit(self, dataset: Dataset, budget: Budget, run: FitRun | None = None) -> SceneFit:
        steps = int(self.scene.info.training.get("steps") or 0)
        return SceneFit(self.scene, Cost(self.seconds, steps, None, len(self.scene.to_bytes())))


@dataclass(frozen=True, eq=False)
class SceneFit(Fitted):
    """A trained scene."""

    scene: GaussianScene
    cost: Cost

    def render(self, probe: Probe, poses: FloatArray, height: int, width: int) -> FrameArray:
        frames = [self._frame(probe, pose[None], height, width) for pose in poses]
        return torch.cat(frames).numpy() if frames else torch.zeros((0, height, width)).numpy()

    def _frame(self, probe: Probe, pose: FloatArray, height: int, width: int) -> torch.Tensor:
        with torch.no_grad():
            return render(self.scene, probe, pose, height=height, width=width, outputs=("bmode",))["bmode"].cpu()

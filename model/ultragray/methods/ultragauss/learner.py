"""One fit of UltraGauss: a frame a step."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from ultragray.backends.poses import scene_poses
from ultragray.backends.weighted import WeightedSums, weighted_sums
from ultragray.datasets.sweep import Dataset
from ultragray.errors import DatasetInvalid
from ultragray.methods.learner import Learner
from ultragray.methods.parts.slices import frame_of_step
from ultragray.methods.ultragauss.field import GAUSSIANS, Field
from ultragray.methods.ultragauss.resampling import follow, is_due, resample
from ultragray.probe import FloatArray, Probe
from ultragray.scene import GaussianScene
from ultragray.training.data.geometry import Geometry
from ultragray.training.steps.losses import SSIM_WINDOW, image_loss
from ultragray.training.steps.refinement import PullStatistics

STRUCTURE = 0.5  # of the loss is 1 − SSIM, the rest L1
RATES = {
    "means": 1.6e-4,  # × the scene's scale in cm
    "scales": 5e-3,
    "quats": 1e-3,
    "transmittances": 0.05,
    "sh0": 2.5e-3,
    "background_weight": 0.05,
    "background_intensity": 2.5e-3,
    "density": 0.05,
}
LAST_MEANS_RATE = 0.01  # × the first
EPSILON = 1e-15
START_OPTICAL_DEPTH = 0.1  # of the last row of the first training frame, on average


class UltraGaussLearner(Learner):
    """The Gaussians, as many as at the start at most, and their background."""

    module: Field

    def __init__(
        self,
        dataset: Dataset,
        seed: int,
        device: torch.device,
        gaussians: Mapping[str, Tensor],
        *,
        casts_shadow: bool,
    ) -> None:
        super().__init__(dataset, seed, device)
        sweep = dataset.train
        if min(sweep.height, sweep.width) < SSIM_WINDOW:
            raise DatasetInvalid(
                f"{sweep.source}: images must have at least {SSIM_WINDOW} rows and columns, got "
                f"{sweep.height}x{sweep.width}"
            )
        self._seed, self._limit = seed, len(gaussians["means"])
        self._scale_cm = Geometry.of(dataset).scene_scale_cm
        self.module = Field({name: tensor.to(device) for name, tensor in gaussians.items()}, casts_shadow=casts_shadow)
        self._begin()
        if casts_shadow:
            with torch.no_grad():
                weight = self._sums(dataset.probe, sweep.poses[:1], sweep.height, sweep.width).weight
                depth = float(weight.sum(dim=1).mean()) * _row_cm(dataset.probe, sweep.height)
                self.module.density.fill_(math.log(START_OPTICAL_DEPTH / depth) if depth > 0.0 else 0.0)

    def _begin(self) -> None:
        """What follows from the module's tensors."""
        named = dict(self.module.named_parameters())
        groups = [{"params": [named[name]], "lr": RATES[name]} for name in RATES if name in named]
        self._groups = {name: place for place, name in enumerate(name for name in RATES if name in named)}
        self.optimizers = {"adam": torch.optim.Adam(groups, eps=EPSILON, fused=True)}
        self._scene: GaussianScene = self.module.scene(self.dataset.centre_mm)
        self._pull = PullStatistics.empty(len(named["means"]), self.device)

    def _sums(self, probe: Probe, poses: FloatArray, height: int, width: int) -> WeightedSums:  # [C, 4, 4] mm
        backend = "cuda" if self.device.type == "cuda" else "cpu"
        return weighted_sums(self._scene, probe, scene_poses(self._scene, poses), height, width, backend)

    def frame(self, probe: Probe, pose: FloatArray, height: int, width: int) -> Tensor:
        sums = self._sums(probe, pose[None], height, width)
        return self.module.image(sums, _row_cm(probe, height))[0]

    def loss(self, step: int, steps: int) -> Tensor:
        means = self.optimizers["adam"].param_groups[self._groups["means"]]
        means["lr"] = RATES["means"] * self._scale_cm * LAST_MEANS_RATE ** (step / steps)
        place = frame_of_step(step, len(self.images), self._seed)
        rendered = self.frame(self.dataset.probe, self.dataset.train.poses[place], *self.images.shape[1:])
        return image_loss(rendered[None], self.image(place)[None], STRUCTURE)

    def after_step(self, step: int, steps: int) -> None:
        self._scene = self.module.scene(self.dataset.centre_mm)  # a fused step is no change that a prepared one notices
        gradient = self.module.gaussians["means"].grad
        assert gradient is not None
        self._pull.add(gradient)
        if is_due(step + 1, steps):
            self._resample()

    def _resample(self) -> None:
        before = self.optimizers["adam"]
        states = {name: before.state[before.param_groups[place]["params"][0]] for name, place in self._groups.items()}
        with torch.no_grad():
            gaussians, origin = resample(
                self.module.gaussians,
                self._pull.mean(),
                limit=self._limit,
                scene_scale_cm=self._scale_cm,
                generator=self.generator,
            )
        self.module.replace(gaussians)
        self._begin()
        after = self.optimizers["adam"]
        for name, place in self._groups.items():
            state = follow(states[name], origin) if name in GAUSSIANS else states[name]
            after.state[after.param_groups[place]["params"][0]] = state

    def state(self) -> dict[str, Tensor]:
        return {**super().state(), "pull.total": self._pull.total, "pull.seen": self._pull.seen}

    def load(self, state: Mapping[str, Tensor]) -> None:
        super().load(state)
        total, seen = (state[f"pull.{name}"].to(self.device) for name in ("total", "seen"))
        self._pull = PullStatistics(total, seen)

    def load_model(self, tensors: Mapping[str, Tensor]) -> None:
        """Of as many Gaussians as there are in it."""
        self.module.replace({name: tensors[name].to(self.device) for name in GAUSSIANS})
        super().load_model(tensors)
        self._begin()


def _row_cm(probe: Probe, height: int) -> float:
    return (probe.far_mm - probe.near_mm) / 10.0 / height

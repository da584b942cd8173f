"""The updates of a run: their schedule, Adam over the raw parameters, and the refinement that adds and removes
Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ultragray import _cpu
from ultragray.learn.training.config import TrainingConfig
from ultragray.rendering.backends.inputs import spatial_order

BEAM_INTENSITY_RATE = 3.0  # a beam dims what it spreads: intensities have further to go than from the frames' own


class Schedule:
    """The schedules of one run. Steps count from 0; `step` of n completed steps is the next one."""

    def __init__(self, config: TrainingConfig, *, scene_scale_cm: float, batch_size: int) -> None:
        assert config.steps is not None
        assert config.transmittance_rate is not None
        self._config, self.steps = config, config.steps
        root = batch_size**0.5
        self._first_rates = {
            "means": config.means_rate * scene_scale_cm * root,
            "scales": config.scales_rate * root,
            "quats": config.quats_rate * root,
            "transmittances": config.transmittance_rate * root,
            "sh0": config.sh0_rate * root * (BEAM_INTENSITY_RATE if config.has_beam else 1.0),
            "shN": config.shn_rate * root,
        }
        last = config.refinement_end * self.steps
        after = [round(last * (k + 1) / config.refinements) for k in range(config.refinements)]
        # What is added by a refinement must still be trained. Several after one step become the last of them.
        self._refinements = {min(done, self.steps - 1): place for place, done in enumerate(after)}

    def rates(self, step: int) -> dict[str, float]:
        """Adam's rate for each parameter: exponential decay from the first to the last step."""
        config = self._config
        decay = config.final_rate ** (step / self.steps)
        return {name: rate * decay for name, rate in self._first_rates.items()}

    def sh_degree(self, step: int) -> int:
        """The degree of the harmonics in use: one more at each multiple of sh_start."""
        first = self._config.sh_start * self.steps
        reached = self._config.sh_degree if first == 0 else int(step / first)
        return min(reached, self._config.sh_degree)

    def has_floor(self, step: int) -> bool:
        return step < self._config.floor_end * self.steps

    def refinement(self, done: int) -> int | None:
        """The number, from 0, of the refinement that is due after `done` steps; None where none is due."""
        return self._refinements.get(done) if done > 0 else None

    def gaussian_limit(self, refinement: int) -> int:
        config = self._config
        assert config.initial_gaussians is not None
        assert config.max_gaussians is not None
        if config.growth == "threshold":
            return config.max_gaussians
        share = (refinement + 1) / config.refinements
        return config.initial_gaussians + round(share * (config.max_gaussians - config.initial_gaussians))


MOMENTS, STEP = ("exp_avg", "exp_avg_sq"), "step"


def is_trained(name: str, shape: Sequence[int], config: TrainingConfig) -> bool:
    return math.prod(shape) > 0 and (config.transmittance or name != "transmittances")


class Optimizer:
    """Adam with the released settings for batches of b: betas 1 − 0.1·b and 1 − 0.001·b, eps 1e-15/√b.

    One pass over memory: by the C++ kernel on a CPU, by torch's fused one elsewhere. That is called as it is:
    torch.optim.Adam loads torch's compiler first, which takes seconds. Only parameters that require a gradient are
    trained.
    """

    def __init__(self, parameters: Mapping[str, Tensor], *, batch_size: int, scale_penalty: float = 0.0) -> None:
        """`scale_penalty`: λ of λ·mean(exp(scales)), a part of the loss whose gradient is added here."""
        self._trained = {name: tensor for name, tensor in parameters.items() if tensor.requires_grad}
        self._betas = max(0.0, 1.0 - 0.1 * batch_size), max(0.0, 1.0 - 0.001 * batch_size)
        self._eps, self._scale_penalty = 1e-15 / batch_size**0.5, scale_penalty
        self._state: dict[str, dict[str, Tensor]] = {}  # by parameter: MOMENTS and the number of steps

    def step(self, rates: Mapping[str, float]) -> Tensor | float:
        """One update in place, with a rate for each parameter; those without a gradient stay.

        Returns the penalty of the scales before it.
        """
        updated = {name: tensor for name, tensor in self._trained.items() if tensor.grad is not None}
        for name, parameter in updated.items():
            if name not in self._state:
                self._state[name] = {moment: torch.zeros_like(parameter) for moment in MOMENTS}
                self._state[name][STEP] = torch.zeros((), device=parameter.device)
            self._state[name][STEP] += 1
        on_cpu = all(parameter.device.type == "cpu" for parameter in updated.values())
        penalty = self._step_by_kernel(updated, rates) if on_cpu else self._step_by_torch(updated, rates)
        for parameter in updated.values():
            parameter.grad = None
        return penalty

    def _step_by_kernel(self, updated: Mapping[str, Tensor], rates: Mapping[str, float]) -> float:
        states = [self._state[name] for name in updated]
        penalties: list[float] = _cpu.adam(
            values=[parameter.detach().numpy() for parameter in updated.values()],
            gradients=[_gradient(parameter).contiguous().numpy() for parameter in updated.values()],
            first=[state[MOMENTS[0]].numpy() for state in states],
            second=[state[MOMENTS[1]].numpy() for state in states],
            steps=[int(state[STEP].numpy()) for state in states],
            rates=[rates[name] for name in updated],
            penalties=[self._scale_penalty if name == "scales" else 0.0 for name in updated],
            beta1=self._betas[0],
            beta2=self._betas[1],
            eps=self._eps,
            threads=torch.get_num_threads(),
            instruction_set="auto",
        )
        return sum(penalties)

    def _step_by_torch(self, updated: Mapping[str, Tensor], rates: Mapping[str, float]) -> Tensor | float:
        penalty: Tensor | float = 0.0
        for name, parameter in updated.items():
            state, gradient = self._state[name], _gradient(parameter)
            if name == "scales" and self._scale_penalty:
                deviations = parameter.detach().exp()
                gradient = gradient.add(deviations, alpha=self._scale_penalty / deviations.numel())
                penalty = self._scale_penalty * deviations.mean()
            torch._fused_adam_(
                [parameter.detach()],
                [gradient],
                [state[MOMENTS[0]]],
                [state[MOMENTS[1]]],
                [],
                [state[STEP]],
                lr=rates[name],
                beta1=self._betas[0],
                beta2=self._betas[1],
                weight_decay=0.0,
                eps=self._eps,
                amsgrad=False,
                maximize=False,
            )
        return penalty

    def replace(self, parameters: Mapping[str, Tensor], origin: Tensor, *, like_others: bool = False) -> None:
        """Goes on with new tensors: row i was row `origin[i]` of the old, or is a new Gaussian where that is −1.

        The moments of a new one are 0, which late in a run makes its first steps many times as long as those of others:
        what corrects young moments counts the steps of the run. `like_others`: its second moment is their mean.
        """
        self._trained = {name: parameters[name] for name in self._trained}
        for state in self._state.values():
            for moment in MOMENTS:
                moved = state[moment][origin.clamp(min=0)]
                is_second = moment == MOMENTS[1]
                moved[origin < 0] = state[moment].mean(dim=0) if like_others and is_second else 0.0
                state[moment] = moved

    def tensors(self) -> dict[str, Tensor]:
        return {f"{name}.{key}": value for name, state in self._state.items() for key, value in state.items()}

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Inverse of `tensors`, which may lie on another device than the parameters."""
        for name, parameter in self._trained.items():
            stored = {key: tensors.get(f"{name}.{key}") for key in (*MOMENTS, STEP)}
            state = {key: value.to(parameter.device) for key, value in stored.items() if value is not None}
            if state:
                self._state[name] = state


def _gradient(parameter: Tensor) -> Tensor:
    assert parameter.grad is not None
    return parameter.grad


SPLIT_SHRINK = 1.6  # standard deviations of the halves of a split Gaussian are divided by this


class PullStatistics:
    """Mean over the steps since the last refinement of ‖∂L/∂mean‖, where a Gaussian was seen at all."""

    def __init__(self, total: Tensor, seen: Tensor) -> None:
        self.total = total  # [N]
        self.seen = seen  # [N] steps

    @classmethod
    def empty(cls, count: int, device: torch.device) -> PullStatistics:
        return cls(torch.zeros(count, device=device), torch.zeros(count, device=device))

    def add(self, gradient: Tensor) -> None:  # [N, 3]
        x, y, z = gradient.unbind(-1)  # column by column: 2.5 times as fast as a norm over three
        pull = (x * x).addcmul_(y, y).addcmul_(z, z).sqrt_()
        self.total += pull
        self.seen += pull > 0

    def mean(self) -> Tensor:  # [N]
        return self.total / self.seen.clamp(min=1.0)


class Refined(NamedTuple):
    """New parameters, in spatial order; row i was row `origin[i]` before, or is a new Gaussian where that is −1."""

    parameters: dict[str, Tensor]
    origin: Tensor  # [N]
    parent: Tensor  # [N] the row before that each comes from, new ones too


def refine(
    parameters: dict[str, Tensor],
    pull: Tensor,  # [N] mean ‖∂L/∂mean‖
    *,
    limit: int,
    scene_scale_cm: float,
    config: TrainingConfig,
    generator: torch.Generator,
) -> Refined:
    """One refinement of the released recipe, up to `limit` Gaussians.

    Candidates, those pulled at most first, are duplicated where their largest standard deviation is at most
    split_scale × scene scale, else replaced by two of it, drawn from the Gaussian itself and 1.6 times smaller. Then
    all that are larger than prune_above, or smaller than prune_below, × scene scale go.
    """
    least = config.growth_gradient if config.growth == "threshold" else 0.0
    order = torch.argsort(pull, descending=True, stable=True)[: max(0, limit - len(pull))]  # each takes one more place
    chosen = order[pull[order] > least]
    is_large = _largest_cm(parameters["scales"][chosen]) > config.split_scale * scene_scale_cm
    split, duplicated = chosen[is_large], chosen[~is_large]
    stays = torch.ones(len(pull), dtype=torch.bool, device=pull.device)
    stays[split] = False
    (kept,) = torch.nonzero(stays, as_tuple=True)
    halves = _halves({name: tensor[split] for name, tensor in parameters.items()}, config, generator)
    grown = {name: torch.cat([tensor[kept], tensor[duplicated], halves[name]]) for name, tensor in parameters.items()}
    largest = _largest_cm(grown["scales"])
    useful = (largest <= config.prune_above * scene_scale_cm) & (largest >= config.prune_below * scene_scale_cm)
    origin = torch.cat([kept, kept.new_full((len(useful) - len(kept),), -1)])
    (survivors,) = torch.nonzero(useful, as_tuple=True)
    order = survivors[spatial_order(grown["means"][survivors])]
    parent = torch.cat([kept, duplicated, split, split])
    return Refined({name: tensor[order] for name, tensor in grown.items()}, origin[order], parent[order])


def _largest_cm(scales: Tensor) -> Tensor:  # [N, 3] log cm -> [N]
    return scales.amax(dim=-1).exp()


def _halves(
    parameters: dict[str, Tensor], config: TrainingConfig, generator: torch.Generator
) -> dict[str, Tensor]:  # rows n -> 2·n
    both = {name: torch.cat([tensor, tensor]) for name, tensor in parameters.items()}
    deviates = torch.randn(both["means"].shape, generator=generator).to(both["means"])
    both["means"] = both["means"] + rotate(both["quats"], deviates * both["scales"].exp())
    both["scales"] = both["scales"] - math.log(SPLIT_SHRINK)
    both["sh0"] = both["sh0"] * config.split_intensity
    return both


def rotate(quats: Tensor, vectors: Tensor) -> Tensor:  # [N, 4] wxyz of any norm, [N, 3] -> [N, 3]
    """v + 2w·(u×v) + 2u×(u×v) with the quaternion (w, u) normalised."""
    unit = quats / quats.norm(dim=-1, keepdim=True)
    w, u = unit[:, :1], unit[:, 1:]
    across = torch.linalg.cross(u, vectors)
    rotated: Tensor = vectors + 2.0 * (w * across + torch.linalg.cross(u, across))
    return rotated

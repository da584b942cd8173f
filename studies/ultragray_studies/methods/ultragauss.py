"""From the sums over Gaussians to an image: the average with a background, and the shadow."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from ultragray.errors import DatasetInvalid
from ultragray.geometry.probe import FloatArray, ParallelLines, Probe
from ultragray.learn.evaluation.methods import BudgetKind
from ultragray.learn.sweep import Dataset
from ultragray.learn.training.config import TrainingConfig
from ultragray.learn.training.geometry import Geometry
from ultragray.learn.training.losses import SSIM_WINDOW, image_loss
from ultragray.learn.training.optimizer import PullStatistics, refine
from ultragray.rendering.backends.inputs import scene_poses, spatial_order
from ultragray.rendering.backends.registry import WeightedSums, weighted_sums
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.info import SceneInfo
from ultragray_studies.methods.learner import LearnedMethod, Learner
from ultragray_studies.methods.method import Budget, Description
from ultragray_studies.methods.parts import Box, frame_of_step


def average(
    weight_sum: Tensor,  # [C, H, W] Σ w
    intensity_sum: Tensor,  # [C, H, W] Σ c·w
    background_weight: Tensor,  # scalar, α_BG
    background_intensity: Tensor,  # scalar, c_BG
) -> Tensor:  # [C, H, W]
    """C = (Σ w c + α_BG c_BG) / (Σ w + α_BG)."""
    return (intensity_sum + background_weight * background_intensity) / (weight_sum + background_weight)


def shadow(weight_sum: Tensor, density: Tensor, row_cm: float) -> Tensor:  # [C, H, W], scalar 1/cm -> [C, H, W]
    """T(p) = exp(−κ·Σ w̄ δ) over the pixels of the scan line from the first down to p, p included; δ is row_cm.

    The first pixel of a scan line has T = exp(−κ·w̄·δ) of its own w̄, not 1.
    """
    return torch.exp(-density * row_cm * weight_sum.cumsum(dim=-2))


# All that UltraGauss learns: the Gaussians, the background, and the density that casts shadows.


PER_GAUSSIAN = ("means", "scales", "quats", "transmittances", "sh0")  # the parameters with a row for each Gaussian
START_BACKGROUND_WEIGHT = 0.1  # of one Gaussian at its centre
START_BACKGROUND_LOGIT = -3.0  # c_BG = 0.05
START_DENSITY = 1.0  # 1/cm; a fit sets it by what its first image weighs


class Field(nn.Module):
    """Raw parameters; `transmittances` holds the logits of the weights (`ultragray.rendering.backends.registry`)."""

    def __init__(self, gaussians: Mapping[str, Tensor], *, casts_shadow: bool) -> None:
        super().__init__()
        self.replace(gaussians)
        device = gaussians["means"].device
        self.background_weight = nn.Parameter(torch.tensor(math.log(START_BACKGROUND_WEIGHT), device=device))  # log
        self.background_intensity = nn.Parameter(torch.tensor(START_BACKGROUND_LOGIT, device=device))  # logit
        if casts_shadow:
            self.density = nn.Parameter(torch.tensor(math.log(START_DENSITY), device=device))  # log of κ, 1/cm
        self.casts_shadow = casts_shadow

    def replace(self, gaussians: Mapping[str, Tensor]) -> None:
        """Goes on with other Gaussians, any number of them."""
        for name in PER_GAUSSIAN:
            setattr(self, name, nn.Parameter(gaussians[name].detach().clone()))

    @property
    def gaussians(self) -> dict[str, Tensor]:
        """The parameters with a row for each Gaussian."""
        parameters = dict(self.named_parameters())
        return {name: parameters[name] for name in PER_GAUSSIAN}

    def scene(self, centre_mm: FloatArray) -> GaussianScene:
        """The same tensors as the kernels take them; never saved, as its transmittances are weights."""
        gaussians = self.gaussians
        count = len(gaussians["means"])
        info = SceneInfo(centre_mm=centre_mm.tolist(), intensity="sigmoid", gaussian_count=count)
        return GaussianScene(**gaussians, shN=gaussians["sh0"].detach()[:, :0], info=info)  # type: ignore[arg-type]

    def image(self, sums: WeightedSums, row_cm: float) -> Tensor:  # [C, H, W]
        """C, or T·C where shadows are cast."""
        image = average(*sums, self.background_weight.exp(), self.background_intensity.sigmoid())
        return image * shadow(sums.weight, self.density.exp(), row_cm) if self.casts_shadow else image


# The Gaussians that a fit starts from: raw parameters (docs/physics.md §2), in cm about the scene's centre.


START_LOGIT = 1.0  # α = σ(1) = 0.731
LOW, HIGH = 4.0, 5.0  # of the entries of L, in the normalised volume
LEAST_PRECISION = 1e-6  # β, likewise


def wide_start(dataset: Dataset, count: int, generator: torch.Generator) -> dict[str, Tensor]:
    """The author's: each Gaussian of the precision L·Lᵀ + β·1, all entries of the lower triangle L uniform in [4, 5).

    The normalised volume is the cube of side 2 around the corners of the training frames.
    """
    lower = (LOW + (HIGH - LOW) * torch.rand((count, 3, 3), generator=generator, dtype=torch.float64)).tril()
    precision = lower @ lower.transpose(1, 2) + LEAST_PRECISION * torch.eye(3, dtype=torch.float64)
    values, axes = torch.linalg.eigh(precision)  # [N, 3], [N, 3, 3] with the axes as columns
    axes[:, :, 0] *= torch.linalg.det(axes)[:, None]  # no mirror
    unit_cm = Box.of(dataset.train).largest_half_mm / 10.0
    points_mm, _ = _points(dataset, count, generator)
    return _start(dataset, points_mm, (unit_cm * values.rsqrt()).log(), _quaternions(axes))


def even_start(dataset: Dataset, count: int, generator: torch.Generator) -> dict[str, Tensor]:
    """Gaussians whose standard deviation is the side of the cube that each has to itself: (volume / N)^(1/3).

    Across the frames, along elevation, it is at least half the spacing of the frames: else there would be Gaussians
    between them that no frame trains, and a plane in a gap would show those.
    """
    points_mm, rotations = _points(dataset, count, generator)
    side_mm = (_volume_mm3(dataset) / count) ** (1 / 3)
    deviations_mm = torch.tensor([side_mm, max(side_mm, _thickness_mm(dataset) / 2.0), side_mm], dtype=torch.float64)
    return _start(
        dataset, points_mm, (deviations_mm / 10.0).log().expand(count, 3), _quaternions(torch.from_numpy(rotations))
    )


def _start(dataset: Dataset, points_mm: FloatArray, scales: Tensor, quats: Tensor) -> dict[str, Tensor]:
    means = torch.from_numpy(points_mm - dataset.centre_mm) / 10.0
    parameters = {
        "means": means,
        "scales": scales,
        "quats": quats,
        "transmittances": torch.full((len(scales),), START_LOGIT),
        "sh0": torch.zeros((len(scales), 1, 1)),  # c = 0.5
    }
    order = spatial_order(means)
    return {name: tensor[order].float().contiguous() for name, tensor in parameters.items()}


def _thickness_mm(dataset: Dataset) -> float:
    """By which a frame stands for the space around its plane."""
    geometry = Geometry.of(dataset)
    return geometry.frame_spacing_mm or geometry.pixel_mm


def _volume_mm3(dataset: Dataset) -> float:
    """Of the space that the frames acquire, each as thick as their spacing."""
    probe = dataset.probe
    breadth_mm = (probe.lines.breadth_mm(probe.near_mm) + probe.lines.breadth_mm(probe.far_mm)) / 2.0
    return len(dataset.train) * _thickness_mm(dataset) * probe.scan_line_length_mm * breadth_mm


def _points(
    dataset: Dataset, count: int, generator: torch.Generator
) -> tuple[FloatArray, FloatArray]:  # [N, 3] mm in the tracker's frame, [N, 3, 3]
    """Points drawn uniformly in that space, and the axes of the frame that each lies at."""
    sweep, probe = dataset.train, dataset.probe
    frames = torch.randint(len(sweep), (count,), generator=generator).numpy()
    deep, across, beside = torch.rand((3, count), generator=generator, dtype=torch.float64).numpy()
    if not isinstance(probe.lines, ParallelLines):  # lines that fan out: as many more points as they are further apart
        near, far = probe.near_mm, probe.far_mm
        deep = (np.sqrt(near**2 + deep * (far**2 - near**2)) - near) / (far - near)
    points = probe.points_mm(deep, across)
    points[:, 1] += (beside - 0.5) * _thickness_mm(dataset)
    poses = sweep.poses[frames]
    return np.einsum("nij,nj->ni", poses[:, :3, :3], points) + poses[:, :3, 3], poses[:, :3, :3]


def _quaternions(axes: Tensor) -> Tensor:  # [N, 3, 3] rotations -> [N, 4] wxyz
    """By the largest of the four components, so that no digits are lost."""
    xx, yy, zz = axes.diagonal(dim1=1, dim2=2).unbind(-1)
    x = axes[:, 2, 1] - axes[:, 1, 2]
    y = axes[:, 0, 2] - axes[:, 2, 0]
    z = axes[:, 1, 0] - axes[:, 0, 1]
    xy, xz, yz = axes[:, 0, 1] + axes[:, 1, 0], axes[:, 0, 2] + axes[:, 2, 0], axes[:, 1, 2] + axes[:, 2, 1]
    products = torch.stack(  # 4·q_a·q_b
        [
            torch.stack([1 + xx + yy + zz, x, y, z], dim=-1),
            torch.stack([x, 1 + xx - yy - zz, xy, xz], dim=-1),
            torch.stack([y, xy, 1 - xx + yy - zz, yz], dim=-1),
            torch.stack([z, xz, yz, 1 - xx - yy + zz], dim=-1),
        ],
        dim=1,
    )
    largest = products.diagonal(dim1=1, dim2=2).argmax(dim=-1)
    return torch.nn.functional.normalize(products[torch.arange(len(axes)), largest], dim=-1)


# Densify and resample, as in 3D Gaussian Splatting: useless Gaussians go, others are split or duplicated instead.


INTERVAL = 100  # steps
FIRST, LAST = 500 / 30_000, 15_000 / 30_000  # as shares of the steps
LEAST_WEIGHT = 0.005
# Of 3D Gaussian Splatting: above 0.01 × the scene's scale a Gaussian is split, else duplicated. Sizes are not pruned.
_RECIPE = TrainingConfig.preset("fast", growth="even", split_scale=0.01, prune_above=100.0, prune_below=0.0)
MOMENTS = ("exp_avg", "exp_avg_sq")


def is_due(done: int, steps: int) -> bool:
    """Whether Gaussians are resampled after `done` of so many steps."""
    return done % INTERVAL == 0 and FIRST * steps <= done <= LAST * steps


def resample(
    gaussians: dict[str, Tensor],
    pull: Tensor,  # [N] mean ‖∂L/∂mean‖
    *,
    limit: int,
    scene_scale_cm: float,
    generator: torch.Generator,
) -> tuple[dict[str, Tensor], Tensor]:
    """New Gaussians, `limit` at most, and the row of each before, −1 for a new one.

    Weights under 0.005 go; then those that are pulled most are split or duplicated, as many as there is room for.
    """
    (kept,) = torch.nonzero(gaussians["transmittances"].sigmoid() >= LEAST_WEIGHT, as_tuple=True)
    refined = refine(
        {name: tensor[kept] for name, tensor in gaussians.items()},
        pull[kept],
        limit=limit,
        scene_scale_cm=scene_scale_cm,
        config=_RECIPE,
        generator=generator,
    )
    origin = torch.where(refined.origin < 0, -1, kept[refined.origin.clamp(min=0)])
    return refined.parameters, origin


def follow(moments: dict[str, Tensor], origin: Tensor) -> dict[str, Tensor]:
    """Adam's state of a parameter after its rows were resampled: new rows begin without momentum."""
    moved = dict(moments)
    for name in MOMENTS:
        rows = moments[name][origin.clamp(min=0)]
        rows[origin < 0] = 0.0
        moved[name] = rows
    return moved


# One fit of UltraGauss: a frame a step.


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
            state = follow(states[name], origin) if name in PER_GAUSSIAN else states[name]
            after.state[after.param_groups[place]["params"][0]] = state

    def state(self) -> dict[str, Tensor]:
        return {**super().state(), "pull.total": self._pull.total, "pull.seen": self._pull.seen}

    def load(self, state: Mapping[str, Tensor]) -> None:
        super().load(state)
        total, seen = (state[f"pull.{name}"].to(self.device) for name in ("total", "seen"))
        self._pull = PullStatistics(total, seen)

    def load_model(self, tensors: Mapping[str, Tensor]) -> None:
        """Of as many Gaussians as there are in it."""
        self.module.replace({name: tensors[name].to(self.device) for name in PER_GAUSSIAN})
        super().load_model(tensors)
        self._begin()


def _row_cm(probe: Probe, height: int) -> float:
    return (probe.far_mm - probe.near_mm) / 10.0 / height


# UltraGauss as a method: v1 of its paper, and with the shadow of the version at ICLR.


STEPS = 30_000
GAUSSIANS = 300_000  # of the author's recipe


@dataclass(frozen=True)
class UltraGauss(LearnedMethod):
    """Weighted Gaussians, averaged pixel by pixel."""

    name: str = "ultragauss"
    casts_shadow: bool = False

    def describe(self) -> Description:
        average = "C = (sum(w c) + a_BG c_BG) / (sum(w) + a_BG), w = a exp(-d'Ad / 2)"
        shadow = "image = T C, T(p) = exp(-k sum(W delta)) down the scan line to p, p included, W = sum(w)"
        return Description(
            title="UltraGauss with shadow" if self.casts_shadow else "UltraGauss",
            source="Eid, Namburete and Henriques, arXiv 2505.05643" + (", ICLR 2026" if self.casts_shadow else ""),
            summary="3D Gaussians cut by the image plane, their intensities averaged by weight and density"
            + (", darkened by what lies above." if self.casts_shadow else "; nothing casts a shadow."),
            equations=(average, shadow) if self.casts_shadow else (average,),
            choices=(
                "From secondary sources: the paper's code was not found.",
                "Equal time: as many Gaussians as this project's scene takes for the sweep, their standard deviation "
                "(volume / N)^(1/3), across the frames at least half the spacing of these. Author's recipe: 300,000 "
                "with the published start.",
                "Steps are not published: 30,000, one frame each. Rates not published: those of 3D Gaussian Splatting.",
                "Loss weights not published: L1 and 1 - SSIM, half each.",
                "Densify and resample every 100 steps within the first half: weights under 0.005 go, those that the "
                "images pull most are split or duplicated in their place; never more Gaussians than at the start.",
                "A from standard deviations and a rotation; L L' + beta, beta = 1e-6, is used for the published start.",
                "a_BG starts at 0.1, c_BG at 0.05; both are learned.",
                "A Gaussian counts where w is at least 1/255 (published: within 95% of its mass), w is at most 0.999, "
                "and it counts nowhere with its mean before the face or beyond the last row.",
                *(
                    ("The unit of delta is not published: k is learned, from an optical depth of 0.1 on.",)
                    if self.casts_shadow
                    else ()
                ),
            ),
            published_steps=STEPS,
        )

    def learner(self, dataset: Dataset, budget: Budget, seed: int, device: torch.device) -> UltraGaussLearner:
        generator = torch.Generator().manual_seed(seed)
        match budget.kind:
            case BudgetKind.AUTHOR:
                gaussians = wide_start(dataset, GAUSSIANS, generator)
            case BudgetKind.EQUAL:
                config = TrainingConfig.preset("fast").resolved(Geometry.of(dataset))
                assert config.max_gaussians is not None
                gaussians = even_start(dataset, config.max_gaussians, generator)
        return UltraGaussLearner(dataset, seed, device, gaussians, casts_shadow=self.casts_shadow)

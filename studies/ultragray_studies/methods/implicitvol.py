"""The network of ImplicitVol: a grey value of a point, by sine layers over an octave encoding."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import mean_axes
from ultragray.learn.sweep import Dataset, Sweep
from ultragray_studies.methods.method import Description
from ultragray_studies.methods.parts import PUBLISHED_FRAMES, EpochMethod, SliceLearner, as_tensor, encode, encoded_size

WIDTH = 128
FIRST_FREQUENCY = 30.0
LAST_BIAS = 0.02


class SineLayer(nn.Module):
    """sin(w0 (W x + b)), W and b uniform in ±1/inputs where it is the first, else in ±√(6/inputs)/w0."""

    def __init__(self, inputs: int, outputs: int, *, is_first: bool = False) -> None:
        super().__init__()
        self.frequency = FIRST_FREQUENCY if is_first else 1.0
        self.bound = 1.0 / inputs if is_first else math.sqrt(6.0 / inputs)
        self.weight = nn.Parameter(torch.empty(outputs, inputs))
        self.bias = nn.Parameter(torch.empty(outputs))

    def forward(self, x: Tensor) -> Tensor:  # [..., inputs] -> [..., outputs]
        # The frequency goes to the weights, of which there are fewer than values.
        values: Tensor = functional.linear(x, self.frequency * self.weight, self.frequency * self.bias).sin()
        return values


class SineField(nn.Module):
    """Four sine layers, the encoded point once more, four sine layers, a linear one, a sine layer, a linear one to 1.

    156,673 parameters; nothing limits the value. The generator is one of the CPU.
    """

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__()
        point = encoded_size()
        self.near = nn.Sequential(SineLayer(point, WIDTH, is_first=True), *(SineLayer(WIDTH, WIDTH) for _ in range(3)))
        self.far = nn.Sequential(SineLayer(WIDTH + point, WIDTH), *(SineLayer(WIDTH, WIDTH) for _ in range(3)))
        self.middle = nn.Linear(WIDTH, WIDTH)
        self.narrow = SineLayer(WIDTH, WIDTH // 2)
        self.last = nn.Linear(WIDTH // 2, 1)
        self.draw(generator)

    def draw(self, generator: torch.Generator) -> None:
        """Draws all weights anew, in the order of the layers; linear layers uniform in ±1/√inputs."""
        for layer in self.modules():
            if isinstance(layer, (SineLayer, nn.Linear)):
                bound = layer.bound if isinstance(layer, SineLayer) else 1.0 / math.sqrt(layer.in_features)
                for parameter in (layer.weight, layer.bias):
                    drawn = torch.empty(parameter.shape).uniform_(-bound, bound, generator=generator)
                    with torch.no_grad():
                        parameter.copy_(drawn)
        nn.init.constant_(self.last.bias, LAST_BIAS)

    def forward(self, points: Tensor) -> Tensor:  # [..., 3] -> [...]
        encoded = encode(points)
        features = self.far(torch.cat([self.near(encoded), encoded], dim=-1))
        value: Tensor = self.last(self.narrow(self.middle(features)))
        return value.squeeze(-1)


# Pose refinement of ImplicitVol: three angles and three translations of each training frame, learned with the field.
#
# Convention. Places are in the field's coordinates: mm less the scene's centre, over half the height of an image. A
# frame is turned about the middle of its image, then put there. Its rotation is M Rz Ry Rx, M the mean rotation of
# the tracked frames: so the angles are small, and far from ±90° about y, where the three are no longer independent.
#
# Gauge. Field and frames may move together without a change of any training frame, and the paper leaves that motion
# open. Here it is taken out where a frame is rendered: `common_motion` is the rigid motion that carries the tracked
# frames onto the refined ones best, and a held-out pose, which is given in the tracker's frame, is moved by it.


MIDDLE = np.array(0.5)  # of an image, down and across


class FramePoses(nn.Module):
    """The poses of the training frames, which begin as the tracker's."""

    def __init__(self, sweep: Sweep, centre_mm: FloatArray, half_height_mm: float, device: torch.device) -> None:
        super().__init__()
        axes = mean_axes(sweep.poses)
        middle_mm = sweep.probe.points_mm(MIDDLE, MIDDLE)
        middles_mm = sweep.poses[:, :3, :3] @ middle_mm + sweep.poses[:, :3, 3]
        self.angles = nn.Parameter(as_tensor(angles_of(axes.T @ sweep.poses[:, :3, :3]), device))  # [F, 3] about x y z
        self.shifts = nn.Parameter(as_tensor((middles_mm - centre_mm) / half_height_mm, device))  # [F, 3]
        self._axes = as_tensor(axes, device)
        self._middle_mm, self._half_height_mm = as_tensor(middle_mm, device), half_height_mm
        self._corners_mm = as_tensor(sweep.probe.corners_mm(), device)  # [K, 3]
        self._tracked_corners = as_tensor((sweep.corners_mm() - centre_mm) / half_height_mm, device)  # [F, K, 3]

    def points(self, place: int, pixels_mm: Tensor) -> Tensor:  # [..., 3] -> [..., 3]
        """Points of the probe frame (mm), seen from a training frame's pose, in the field's coordinates."""
        centred = (pixels_mm - self._middle_mm) / self._half_height_mm
        return centred @ (self._axes @ rotation_of(self.angles[place])).T + self.shifts[place]

    def common_motion(self) -> tuple[Tensor, Tensor]:  # [3, 3], [3]
        """Rotation and translation, in the field's coordinates, that carry tracked corners onto refined ones best."""
        centred = (self._corners_mm - self._middle_mm) / self._half_height_mm
        refined = centred @ (self._axes @ rotation_of(self.angles)).mT + self.shifts[:, None]  # [F, K, 3]
        before, after = self._tracked_corners.reshape(-1, 3).double(), refined.reshape(-1, 3).double()
        mean_before, mean_after = before.mean(dim=0), after.mean(dim=0)
        left, _, right = torch.linalg.svd((after - mean_after).T @ (before - mean_before))
        signs = torch.ones(3, dtype=left.dtype, device=left.device)
        signs[2] = torch.linalg.det(left @ right)
        rotation = left @ torch.diag(signs) @ right
        return rotation.float(), (mean_after - rotation @ mean_before).float()


def rotation_of(angles: Tensor) -> Tensor:  # [..., 3] about x, y, z -> [..., 3, 3]
    """Rz Ry Rx."""
    (cx, cy, cz), (sx, sy, sz) = angles.cos().unbind(-1), angles.sin().unbind(-1)
    rows = (
        torch.stack([cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx], dim=-1),
        torch.stack([sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx], dim=-1),
        torch.stack([-sy, cy * sx, cy * cx], dim=-1),
    )
    return torch.stack(rows, dim=-2)


def angles_of(rotations: FloatArray) -> FloatArray:  # [F, 3, 3] -> [F, 3] about x, y, z
    """Inverse of `rotation_of`."""
    about_x = np.arctan2(rotations[:, 2, 1], rotations[:, 2, 2])
    about_y = np.arcsin(np.clip(-rotations[:, 2, 0], -1.0, 1.0))
    about_z = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])
    return np.stack([about_x, about_y, about_z], axis=-1)


# The fits of ImplicitVol: of the field alone, and of the field together with the poses of the training frames.


EPOCHS = 10_001  # of the paper
RATE = 1e-3  # of the network and of the poses
NETWORK_DECAY, NETWORK_DECAY_EPOCHS = 0.9954, 10
POSE_DECAY, POSE_DECAY_EPOCHS = 0.9, 100
RESTART_EPOCHS, RESTARTS = 500, 9  # the last before epoch 5,000


def published_epoch(step: int, steps: int) -> int:
    """The epoch of the paper's 10,001 that step `step` (from 0) of `steps` stands for: schedules are stretched."""
    return EPOCHS * step // steps


class FieldLearner(SliceLearner):
    """A fit with the tracker's poses."""

    field: SineField

    def __init__(self, dataset: Dataset, seed: int, device: torch.device) -> None:
        self.half_height_mm = dataset.probe.scan_line_length_mm / 2.0
        super().__init__(dataset, seed, device, dataset.centre_mm, np.full(3, self.half_height_mm))
        self.field = SineField(self.generator).to(device)
        self.module = nn.ModuleDict({"field": self.field})
        self.optimizers = {"field": torch.optim.Adam(self.field.parameters(), RATE)}

    def rates(self, step: int, steps: int) -> dict[str, float]:
        return {"field": RATE * NETWORK_DECAY ** (published_epoch(step, steps) // NETWORK_DECAY_EPOCHS)}


class RefiningLearner(FieldLearner):
    """A fit that moves the training frames too.

    In the first half the network is thrown away at regular steps, and what both optimisers remember with it, while the
    poses are kept: else the network would learn the misplaced frames by heart before these have moved.
    """

    def __init__(self, dataset: Dataset, seed: int, device: torch.device) -> None:
        super().__init__(dataset, seed, device)
        self.poses = FramePoses(dataset.train, self.centre_mm, self.half_height_mm, device)
        self.module = nn.ModuleDict({"field": self.field, "poses": self.poses})
        self.optimizers = {**self.optimizers, "poses": torch.optim.Adam(self.poses.parameters(), RATE)}

    def rates(self, step: int, steps: int) -> dict[str, float]:
        of_poses = RATE * POSE_DECAY ** (published_epoch(step, steps) // POSE_DECAY_EPOCHS)
        return {**super().rates(step, steps), "poses": of_poses}

    def training_points(self, place: int) -> Tensor:
        return self.poses.points(place, self.pixels_mm)

    def rendered_points(self, pixels_mm: Tensor, pose: FloatArray) -> Tensor:
        rotation, translation = self.poses.common_motion()
        return self.in_field(pixels_mm, pose) @ rotation.T + translation

    def after_step(self, step: int, steps: int) -> None:
        if _restarts_before(step + 1, steps) > _restarts_before(step, steps):
            self.field.draw(self.generator)
            for optimizer in self.optimizers.values():
                optimizer.state.clear()


def _restarts_before(step: int, steps: int) -> int:
    """The restarts that are due before step `step` (from 0)."""
    return min(published_epoch(step, steps) // RESTART_EPOCHS, RESTARTS)


# ImplicitVol as methods: with the tracker's poses, and with poses that are refined.


SOURCE = "Yeung et al., arXiv 2109.12108"
FIELD_EQUATIONS = (
    "p = (R x + t - c) / (H_mm / 2), H_mm the height of the image, c the centre of the scene",
    "e(p) = (p, sin p, cos p, sin 2p, cos 2p, ..., sin 2^9 p, cos 2^9 p), 63 numbers",
    "a sine layer: sin(w0 (W x + b)), w0 = 30 in the first, 1 in the others",
    "h = S4(S3(S2(S1(e)))), g = S8(S7(S6(S5(h, e)))), v(p) = L2(S9(L1(g)))",
    "loss = 1 - SSIM(v, image), window 5, sigma 1.5, zeros around the image",
)
FIELD_CHOICES = (
    "The centre of the scene is the mean of the corners of the training frames.",
    "The height of an image is the length of its scan lines, of a convex probe too.",
    "The paper's schedule over 10,001 epochs is stretched to the steps of the budget.",
    "Linear layers begin uniform in ±1/sqrt(inputs), which the paper leaves open.",
    "1 - SSIM in place of -SSIM: the same gradient, and a loss that ends at 0.",
    "SSIM takes an image and its negative for the same; the paper does not say what keeps a fit from the negative, and "
    "nothing does here.",
    "Values are cut off at 0 and 1 where a frame is rendered, not where it is learned.",
)


REFINING_CHOICES = (
    "M is the mean rotation of the tracked frames, so that no frame comes near the angles where Rz Ry Rx "
    "has only two independent ones.",
    "Held-out poses stay as they are given. The paper fixes no common motion of field and frames: here the "
    "rigid motion that carries the tracked training frames onto the refined ones best is applied to them.",
    "A restart of the network clears what the optimisers remember, not their schedules.",
    "One Adam has the poses of all frames: a frame also moves in the steps of others, by its momentum.",
)


class ImplicitVol(EpochMethod):
    """The field alone, with the tracker's poses, or together with the poses of the training frames.

    Those of held-out frames stay as they are given.
    """

    epochs = EPOCHS

    def __init__(self, *, refines: bool = False) -> None:
        self.name = "implicitvol-refined" if refines else "implicitvol"
        self.learns = RefiningLearner if refines else FieldLearner

    def describe(self) -> Description:
        refines = self.learns is RefiningLearner
        return Description(
            title="ImplicitVol, poses refined" if refines else "ImplicitVol",
            source=SOURCE,
            summary="As ImplicitVol, and three angles and three translations of each training frame are learned too."
            if refines
            else "A network of sine layers gives the grey value of a point; a frame is its values at the pixels.",
            equations=(*FIELD_EQUATIONS, *(["R = M Rz Ry Rx, about the middle of the image"] if refines else [])),
            choices=(
                *(REFINING_CHOICES if refines else ["Poses stay the tracker's: all methods see the same."]),
                *FIELD_CHOICES,
            ),
            published_steps=EPOCHS * PUBLISHED_FRAMES,
        )

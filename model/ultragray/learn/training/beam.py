"""The beam of a training: none, a given one, or one that is learned beside the Gaussians (docs/physics.md §7)."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from ultragray.geometry.probe import MAX_THICKNESS_MM, ElevationBeam, Probe
from ultragray.learn.training.config import TrainingConfig

RATE = 0.05  # of Adam, for each of three numbers of the order of one
BETAS = (0.8, 0.99)
MIN_THICKNESS_MM = 0.05
BEGIN = 0.2  # share of the run before which the beam is held: it would make up for Gaussians that are still too dark
START_MM = 2.0  # initial thickness; runs that began with 0.5 to 8 mm ended with the same beam
LEAST_LENGTHS = 0.05  # least depth of field, in lengths of the scan lines: no lens has less
MOST_LENGTHS = 20.0  # greatest depth of field, likewise: a beam beyond it is as thick at every depth


class TrainedBeam:
    """The beam that frames are rendered with. Learned numbers: ln thickness, focus, ln depth of field, [3] float64.

    Thickness and depth of field are in mm, the focus in lengths of the scan lines.
    """

    def __init__(self, config: TrainingConfig, probe: Probe) -> None:
        self._known_beam, self._config = config.given_beam, config
        self._length_mm = length = probe.scan_line_length_mm
        thickness, focus, depth_of_field = (self._known_beam or ElevationBeam(START_MM)).numbers
        if math.isinf(depth_of_field):
            focus, depth_of_field = 0.5 * length, length
        start = math.log(thickness), focus / length, math.log(depth_of_field)
        self._raw = torch.tensor(start, dtype=torch.float64, requires_grad=config.learn_beam)
        self._adam = torch.optim.Adam([self._raw], betas=BETAS) if config.learn_beam else None
        depths = math.log(LEAST_LENGTHS * length), math.log(MOST_LENGTHS * length)
        widths = math.log(MIN_THICKNESS_MM), math.log(MAX_THICKNESS_MM)
        self._low, self._high = torch.tensor([widths, (0.0, 2.0), depths], dtype=torch.float64).unbind(dim=1)

    @property
    def numbers(self) -> ElevationBeam | Tensor | None:
        """The beam as `render` takes it: differentiable where it is learned."""
        if not self._config.learn_beam:
            return self._known_beam
        thickness, focus, depth_of_field = self._raw.unbind()
        return torch.stack([thickness.exp(), focus * self._length_mm, depth_of_field.exp()])

    def step(self, share: float) -> None:
        """One update of the learned numbers, after a share of the run, at a rate that decays like all rates."""
        if self._adam is None:
            return
        if share < BEGIN:
            self._raw.grad = torch.zeros_like(self._raw)  # the beam is held, but Adam counts the step
        self._adam.param_groups[0]["lr"] = RATE * self._config.final_rate**share
        self._adam.step()
        self._adam.zero_grad()
        with torch.no_grad():
            self._raw.clamp_(self._low, self._high)

    def found(self) -> ElevationBeam | None:
        if not self._config.learn_beam:
            return self._known_beam
        thickness, focus, depth_of_field = self._raw.tolist()
        return ElevationBeam(math.exp(thickness), focus * self._length_mm, math.exp(depth_of_field))

    def is_doubtful(self, frame_spacing_mm: float) -> bool:
        """Whether the learned thickness is below half the spacing of frames, which then cannot show it."""
        beam = self.found()
        return self._config.learn_beam and beam is not None and beam.thickness_mm < 0.5 * frame_spacing_mm

    def tensors(self) -> dict[str, Tensor]:
        if self._adam is None:
            return {}
        return {"raw": self._raw.detach(), **self._adam.state[self._raw]}

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        if self._adam is not None:
            self._raw.data.copy_(tensors["raw"])
            self._adam.state[self._raw] = {name: tensors[name].clone() for name in tensors if name != "raw"}


def expected_beam_tensors(config: TrainingConfig) -> dict[str, tuple[torch.dtype, tuple[int, ...]]]:
    if not config.learn_beam:
        return {}
    return {
        **dict.fromkeys(("raw", "exp_avg", "exp_avg_sq"), (torch.float64, (3,))),
        "step": (torch.float32, ()),
    }

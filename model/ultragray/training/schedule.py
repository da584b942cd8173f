"""When what happens in a run: learning rates, harmonics, refinements. Fractions of the config become steps here."""

from __future__ import annotations

from .config import MAX_TRANSMITTANCE_RATE, RELEASED_STEPS, TrainingConfig


class Schedule:
    """The schedules of one run. Steps count from 0; `step` of n completed steps is the next one."""

    def __init__(self, config: TrainingConfig, *, scene_scale_cm: float, batch_size: int) -> None:
        self._config = config
        root = batch_size**0.5
        transmittance = config.transmittance_rate
        if transmittance is None:
            transmittance = min(5e-4 * RELEASED_STEPS / config.steps, MAX_TRANSMITTANCE_RATE)
        self._first_rates = {
            "means": config.means_rate * scene_scale_cm * root,
            "scales": config.scales_rate * root,
            "quats": config.quats_rate * root,
            "transmittances": transmittance * root,
            "sh0": config.sh0_rate * root,
            "shN": config.shn_rate * root,
        }
        last = config.refinement_end * config.steps
        self._refinements = [round(last * (k + 1) / config.refinements) for k in range(config.refinements)]

    def rates(self, step: int) -> dict[str, float]:
        """Adam's rate for each parameter: exponential decay from the first to the last step."""
        decay = self._config.final_rate ** (step / self._config.steps)
        return {name: rate * decay for name, rate in self._first_rates.items()}

    def sh_degree(self, step: int) -> int:
        """The degree of the harmonics in use: one more at each multiple of sh_start."""
        first = self._config.sh_start * self._config.steps
        reached = self._config.sh_degree if first == 0 else int(step / first)
        return min(reached, self._config.sh_degree)

    def intensity_floor(self, step: int) -> float:
        """The least intensity of degree 0 that a Gaussian may have."""
        return self._config.intensity_floor if step < self._config.floor_end * self._config.steps else 0.0

    def refinement(self, done: int) -> int | None:
        """Which refinement, from 0, is due after `done` steps; None: none, as after the last step."""
        if done in self._refinements and 0 < done < self._config.steps:
            return self._refinements.index(done)
        return None

    def gaussian_limit(self, refinement: int) -> int:
        """How many Gaussians there may be after a refinement."""
        config = self._config
        if config.growth == "threshold":
            return config.max_gaussians
        share = (refinement + 1) / config.refinements
        return config.initial_gaussians + round(share * (config.max_gaussians - config.initial_gaussians))

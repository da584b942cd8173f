"""The schedule of a run: learning rates, harmonics, refinements. Fractions of the config become steps here."""

from __future__ import annotations

from ultragray.training.config import TrainingConfig

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
        """Whether intensities are kept above their floors."""
        return step < self._config.floor_end * self.steps

    def refinement(self, done: int) -> int | None:
        """The number, from 0, of the refinement that is due after `done` steps; None where none is due."""
        return self._refinements.get(done) if done > 0 else None

    def gaussian_limit(self, refinement: int) -> int:
        """The number of Gaussians that there may be after a refinement."""
        config = self._config
        assert config.initial_gaussians is not None
        assert config.max_gaussians is not None
        if config.growth == "threshold":
            return config.max_gaussians
        share = (refinement + 1) / config.refinements
        return config.initial_gaussians + round(share * (config.max_gaussians - config.initial_gaussians))

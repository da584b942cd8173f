"""Training: a dataset becomes a scene that is served."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from ultragray.contract import described, kind_field, shown
from ultragray.errors import InvalidArgument
from ultragray.installation import memory_bytes
from ultragray.learn.training.config import PRESET_MEANINGS, PRESETS, TrainingConfig
from ultragray_workers.jobs.kinds.base import Specification, Surroundings

_MAX_SETTINGS, _MAX_SETTING_CHARACTERS = 100, 100
_GIB = 1 << 30


@dataclass(frozen=True)
class TrainJob(Specification):
    """A dataset becomes a scene that is served.

    Raises InvalidArgument, also for a setting that no training has and for a value outside its range.
    """

    dataset: str = described("Name of an uploaded dataset.")
    scene: str = described("Name that the scene will be served under.")
    preset: str = described(PRESET_MEANINGS, "fast", choices=tuple(PRESETS))
    settings: dict[str, Any] = described("Any training settings instead of the preset's.", factory=dict)
    start_scene: str | None = described("Name of a scene to begin with, such as one made from labels.", None)
    kind: Literal["train"] = kind_field("train")

    run_module = "ultragray_workers.jobs.kinds.train_run"
    has_checkpoints = True
    needs_dataset = "dataset"
    needs_scene = "start_scene"
    makes_scene = "scene"

    def __post_init__(self) -> None:
        super().__post_init__()
        _require(self.dataset != "", "dataset", "the name of a dataset", self.dataset)
        is_object = isinstance(self.settings, dict) and len(self.settings) <= _MAX_SETTINGS
        _require(is_object, "settings", f"an object of at most {_MAX_SETTINGS} training settings", self.settings)
        for name in self.settings:
            short = len(name) <= _MAX_SETTING_CHARACTERS
            _require(short, "settings", f"names of at most {_MAX_SETTING_CHARACTERS} characters", name)
        try:
            TrainingConfig.preset(self.preset, **self.settings)
        except InvalidArgument as error:
            raise InvalidArgument(error.detail, field=f"settings.{error.field}") from None

    def check(self, surroundings: Surroundings) -> None:
        """Raises InvalidArgument for more memory than this machine has, unless it is to be a GPU's.

        The worker allows no more than its own machine has left, either, see `ultragray.learn.training.memory`.
        """
        memory_gb = TrainingConfig.preset(self.preset, **self.settings).memory_gb
        if memory_gb is None or self.device.startswith("cuda"):
            return
        most_gb = memory_bytes() / _GIB
        _require(memory_gb <= most_gb, "settings.memory_gb", f"at most the {most_gb:.1f} GiB of the host", memory_gb)


def _require(holds: bool, field: str, expected: str, value: Any) -> None:
    if not holds:
        raise InvalidArgument(f"{field} must be {expected}, got {shown(value)}", field=field)

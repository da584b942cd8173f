"""Motion: a scene gets a mode of motion, as a scene that is served."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ultragray.contract import described, kind_field
from ultragray.errors import InvalidArgument
from ultragray.scene.motion_settings import MotionSettings
from ultragray_workers.jobs.kinds.base import Specification, Surroundings

MAX_NUMBERS = 100_000


@dataclass(frozen=True)
class MotionJob(MotionSettings, Specification):
    """A scene gets a mode of motion: learned from the frames of a dataset, or built in.

    The scene itself stays as it is; the one that moves is served when the job has succeeded. Raises InvalidArgument.
    """

    scene: str = described("Name of the scene, which was trained as if its tissue were still.", kw_only=True)
    into: str = described("Name that the scene that moves will be served under.", kw_only=True)
    dataset: str | None = described("Name of the dataset that the mode is learned from.", None, kw_only=True)
    numbers: tuple[float, ...] | None = described(
        "One for each frame of the recording, such as a belt's reading. Default: they are found in the frames.",
        None,
        most=MAX_NUMBERS,
        kw_only=True,
    )
    kind: Literal["motion"] = kind_field("motion")

    run_module = "ultragray_workers.jobs.kinds.motion_run"
    needs_dataset = "dataset"
    needs_scene = "scene"
    makes_scene = "into"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_source(dataset=self.dataset is not None)
        if self.numbers is not None and self.dataset is None:
            raise InvalidArgument("numbers are of the frames of a dataset, which must be given", field="dataset")

    def check(self, surroundings: Surroundings) -> None:
        """Raises InvalidArgument for the name of a mode that the scene has."""
        assert surroundings.scene is not None
        self.mode_name(surroundings.scene.info.motion)

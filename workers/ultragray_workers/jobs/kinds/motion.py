"""Motion: a scene gets a mode of motion, as a scene that is served."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from typing_extensions import Self

from ultragray.contract import described, kind_field
from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray
from ultragray.geometry.registration import Registration
from ultragray.scene.label_maps import read_vector_field
from ultragray.scene.motion_settings import FIELD, FieldFile, MotionSettings
from ultragray_workers.jobs.kinds.base import Specification, Surroundings

MAX_NUMBERS = 100_000


@dataclass(frozen=True)
class MotionJob(MotionSettings, Specification):
    """A scene gets a mode of motion: learned from the frames of a dataset, of a field of displacements, or built in.

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
    field: FieldFile | None = described(
        "A file with a vector in mm for each voxel, of a number of 1.", None, topic=FIELD, kw_only=True
    )
    field_to_scene: tuple[float, ...] | None = described(
        "Leads the frame of the file into the scene's: 4x4, rigid, mm, row by row. Default: they are the same.",
        None,
        most=16,
        topic=FIELD,
        kw_only=True,
    )
    registration: str | None = described(
        "Name of the registration whose base_to_scene does so instead.", None, topic=FIELD, kw_only=True
    )
    kind: Literal["motion"] = kind_field("motion")

    run_module = "ultragray_workers.jobs.kinds.motion_run"
    needs_dataset = "dataset"
    needs_scene = "scene"
    needs_registration = "registration"
    carries = "field"
    makes_scene = "into"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_source(dataset=self.dataset is not None, field=self.field is not None)
        self.check_field(is_given=self.field is not None)
        if self.numbers is not None and self.dataset is None:
            raise InvalidArgument("numbers are of the frames of a dataset, which must be given", field="dataset")
        if self.registration is not None and (self.field is None or self.field_to_scene is not None):
            raise InvalidArgument("registration is of a field, without field_to_scene", field="registration")
        self.link()

    def link(self) -> FloatArray | None:  # [4, 4] mm
        """The way from the file's frame into the scene's; None where they are the same. Raises InvalidPose."""
        if self.field_to_scene is None:
            return None
        array = np.array(self.field_to_scene)
        exact: FloatArray = check_poses(array.reshape(4, 4) if array.size == 16 else array, field="field_to_scene")[0]
        return exact

    def registered(self, registration: Registration) -> Self:
        to_scene = tuple(value for row in registration.base_to_scene for value in row)
        return replace(self, field_to_scene=to_scene, registration=None)

    def check_carried(self, path: Path) -> None:
        read_vector_field(path, self.field_axes)

    def check(self, surroundings: Surroundings) -> None:
        """Raises InvalidArgument for the name of a mode that the scene has."""
        assert surroundings.scene is not None
        self.mode_name(surroundings.scene.info.motion)

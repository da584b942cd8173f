"""The service under soak, as its visitors know it: where it is, and what each frame of its scenes must show."""

import os
import random
import shutil
import threading
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ultragray import GaussianScene, render

from ..service.conftest import DEMO_PROBE, HEIGHT, WIDTH, RunningService, make_scene

POSES = np.tile(np.eye(4), (12, 1, 1))
POSES[:, 0, 3] = np.arange(-2.75, 3.0, 0.5)  # mm, exact in float32, too, which OpenIGTLink sends
STEADY, CHANGING = "steady", "changing"

Pixels = npt.NDArray[np.uint8]


@dataclass
class Place:
    """Shared by all visitors."""

    service: RunningService
    igtl: str
    dataset: Path  # a folder to upload
    versions: tuple[Path, ...]  # of the scene that changes
    steady_sha256: str
    expected: dict[str, Pixels]  # by the SHA-256 of a scene file: the frames of POSES, [P, H, W]
    over: threading.Event = field(default_factory=threading.Event)

    def check(self, sha256, index, pixels):
        """Asserts that a frame is the one of pose `index`, of the version that it says it is of."""
        assert np.array_equal(pixels, self.expected[sha256][index]), f"pose {index} of {sha256[:12]} looks different"

    def replace_scene(self):
        """Puts another version in the place of the scene that changes, at once."""
        folder = self.service.data_folder
        other = folder / "incoming"
        shutil.copy(random.choice(self.versions), other)
        os.replace(other, folder / f"{CHANGING}.ugr")


def frames_of(path):
    """The frames of POSES as they must be, [P, H, W]."""
    rendered = render(GaussianScene.load(path), None, POSES, height=HEIGHT, width=WIDTH).bmode.numpy()
    return np.round(np.clip(rendered, 0, 1) * np.float32(255)).astype(np.uint8)


def make_scenes(data_folder, versions_folder):
    """Writes the scenes of the data folder, and the versions of the one that changes."""
    versions = tuple(versions_folder / f"{number}.ugr" for number in range(3))
    for seed, path in enumerate((data_folder / f"{STEADY}.ugr", *versions)):
        make_scene(seed=seed, probe=DEMO_PROBE).save(path)
    shutil.copy(versions[0], data_folder / f"{CHANGING}.ugr")
    return versions

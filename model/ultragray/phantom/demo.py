"""The demo scene that comes with the code: a lumbar spine, trained from the sweeps of the built-in phantom.

Frame, mm: the phantom's. x to the patient's right, y caudal, z from the skin into the body; the origin lies on the
skin over the middle vertebra, so that a probe at the origin with quaternion w=1 sees it in cross-section. The
vertebrae are 35 mm apart.

`make demo-scene` trains it; the file that was written last is part of the package.
"""

from __future__ import annotations

import shutil
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ultragray.files import atomic_path
from ultragray.geometry.probe import FloatArray
from ultragray.phantom import PHANTOM_IMAGE_SIDE, PHANTOM_PROBE, Tissue, freehand_poses
from ultragray.phantom.anatomy import LabelArray
from ultragray.scene.info import read_header

if TYPE_CHECKING:
    from ultragray.scene.gaussians import GaussianScene


DEMOS = ("spine", "abdomen")  # the first is a file, the other is made when it is asked for
DEMO_FILE = Path(__file__).with_name("spine.ugr")
DEMO_PROBE = PHANTOM_PROBE
DEMO_IMAGE_SIDE = PHANTOM_IMAGE_SIDE


def load_demo_scene() -> GaussianScene:
    """The demo scene, of `DEMO_PROBE` and images of `DEMO_IMAGE_SIDE` squared.

    Its metrics are those of the phantom's held-out sweep: those of `FrameMetrics`, and `shadow_mae` and
    `shadow_transmittance`, mean absolute error (in [0, 1]) and mean transmittance in the shadow of bone.
    """
    from ultragray.scene.gaussians import GaussianScene

    return GaussianScene.load(DEMO_FILE)


@cache
def simulated_sha256() -> str | None:
    """Of the phantom's dataset, without simulating it: the demo scene was trained from it."""
    return read_header(DEMO_FILE).info.dataset_sha256


def copy_demo_scene(path: str | Path) -> None:
    """Puts the demo scene's file at `path`, whole or not at all, without torch. Raises OSError."""
    with atomic_path(path) as temporary:
        shutil.copyfile(DEMO_FILE, temporary)


def demo_poses(count: int) -> FloatArray:  # [C, 4, 4] mm
    """A freehand sweep of `count` frames along the spine, y from −36 to 36 mm, slightly tilted.

    The middle frame of an odd count is the identity. Raises InvalidArgument for a negative count.
    """
    return freehand_poses(count)


LABELS: dict[int, tuple[str, tuple[Tissue, ...]]] = {
    1: ("bone", (Tissue.BONE,)),
    2: ("muscle", (Tissue.MUSCLE,)),
    3: ("fat", (Tissue.FAT,)),
    4: ("vessel", (Tissue.BLOOD,)),
}
LABEL_NAMES = {label: name for label, (name, _) in LABELS.items()}


def labels_of(tissues: npt.NDArray[np.uint8]) -> LabelArray:
    """The label of each `Tissue`, in any shape; 0 for other tissues than those of LABELS."""
    by_tissue = np.zeros(max(Tissue) + 1, np.uint8)
    for label, (_, named) in LABELS.items():
        by_tissue[list(named)] = label
    return by_tissue[tissues]

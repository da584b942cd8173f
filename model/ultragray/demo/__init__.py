"""The demo scene that comes with the code: a lumbar spine, trained from the sweeps of the built-in phantom.

Frame, mm: the phantom's. x to the patient's right, y caudal, z from the skin into the body; the origin lies on the
skin over the middle vertebra, so that a probe at the origin with quaternion w=1 sees it in cross-section. The
vertebrae are 35 mm apart.

`ultragray.demo.make` trains the scene; the file that it wrote last is part of the package.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from ultragray.files.atomic import atomic_path
from ultragray.phantom import PHANTOM_IMAGE_SIDE, PHANTOM_PROBE, freehand_poses
from ultragray.probe import FloatArray

if TYPE_CHECKING:
    from ultragray.scene import GaussianScene

DEMO_FILE = Path(__file__).with_name("spine.ugr")
DEMO_PROBE = PHANTOM_PROBE
DEMO_IMAGE_SIDE = PHANTOM_IMAGE_SIDE


def load_demo_scene() -> GaussianScene:
    """The demo scene, of `DEMO_PROBE` and images of `DEMO_IMAGE_SIDE` squared.

    Its metrics are those of the phantom's held-out sweep: those of `FrameMetrics`, and `shadow_mae` and
    `shadow_transmittance`, mean absolute error (in [0, 1]) and mean transmittance in the shadow of bone.
    """
    from ultragray.scene import GaussianScene

    return GaussianScene.load(DEMO_FILE)


def copy_demo_scene(path: str | Path) -> None:
    """Puts the demo scene's file at `path`, whole or not at all, without torch. Raises OSError."""
    with atomic_path(path) as temporary:
        shutil.copyfile(DEMO_FILE, temporary)


def demo_poses(count: int) -> FloatArray:  # [C, 4, 4] mm
    """A freehand sweep of `count` frames along the spine, y from −36 to 36 mm, slightly tilted.

    The middle frame of an odd count is the identity. Raises InvalidArgument for a negative count.
    """
    return freehand_poses(count)

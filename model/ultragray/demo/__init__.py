"""The demo scene that comes with the code: an in-silico lumbar spine, made in a second, the same every time.

Frame, mm. x to the patient's right, y caudal, z from the skin into the body; the origin lies on the skin over
the middle vertebra, so that a probe at the origin with quaternion w=1 sees it in cross-section. The vertebrae
are 35 mm apart.

Nothing is trained: each tissue is drawn directly as Gaussians. Bone and fascia are brightest face on, bone
lets nothing through, blood gives no echo and cerebrospinal fluid next to none.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from ..errors import InvalidArgument
from ..pose import check_poses
from ..probe import FloatArray, LinearProbe
from ..scene import GaussianScene
from ..scene_info import SceneInfo
from . import bone, tissue
from .splats import Splats, parameters

DEMO_PROBE = LinearProbe(width_mm=60.0, near_mm=0.0, far_mm=60.0)
DEMO_IMAGE_SIDE = 512
DEMO_POSE_COUNT = 121
CENTRE_MM = (0.0, 0.0, 30.0)
SWEEP_MM = 72.0
_SEED = 20261120


def build_demo_scene() -> GaussianScene:
    """The demo scene, bit for bit the same on every call."""
    sheets = (tissue.skin, tissue.fat_septa, tissue.fasciae, tissue.muscle_septa)
    filling = (tissue.speckle, tissue.perimysium, *sheets)
    walls = (tissue.vessel, tissue.ligaments, tissue.cauda_equina)
    # A stream of its own for each layer: a change to one leaves the others alone.
    generators = (np.random.default_rng([_SEED, layer]) for layer in itertools.count())
    soft = Splats.join(
        tissue.outside_fluid(Splats.join(*(layer(next(generators)) for layer in filling))),
        *(layer(next(generators)) for layer in walls),
    )
    hard = bone.vertebrae(next(generators), -tissue.HALF_LENGTH_MM, tissue.HALF_LENGTH_MM)
    everything = _as_grown(Splats.join(_outside_bone(soft), hard))
    info = SceneInfo(
        centre_mm=CENTRE_MM,
        probe=DEMO_PROBE,
        image_height=DEMO_IMAGE_SIDE,
        image_width=DEMO_IMAGE_SIDE,
        intensity="sigmoid",
        dataset_name="demo lumbar spine (in silico)",
        training={"generator": "ultragray.demo", "seed": _SEED},
    )
    return GaussianScene.from_splats(
        parameters(everything, CENTRE_MM), info=info, training_poses=demo_poses(DEMO_POSE_COUNT)
    )


def _outside_bone(soft: Splats) -> Splats:
    points = soft.centres_mm
    shadow = bone.Shadow(tissue.HALF_WIDTH_MM, tissue.HALF_LENGTH_MM)
    return soft.where((bone.distance_mm(points) > 0.4) & ~shadow.hides(points))


def _as_grown(drawn: Splats) -> Splats:
    """The anatomy with small bends everywhere but on the skin: nothing in a body is straight or symmetric."""
    x, y, z = drawn.centres_mm.T
    rise = np.clip(z / 8.0, 0.0, 1.0)
    bent_x = x + rise * (0.9 * np.sin(y / 27.0 + 0.4) + 0.4 * np.sin(z / 7.0 + x / 11.0))
    ripple = 0.45 * np.sin(x / 6.3 + y / 19.0 + 0.7) + 0.25 * np.sin(x / 2.9 + y / 7.0)
    bent_z = z + rise * (ripple + 0.02 * x)
    return replace(drawn, centres_mm=np.stack([bent_x, y, bent_z], axis=1))


def demo_poses(count: int) -> FloatArray:  # [C, 4, 4] mm
    """A freehand sweep of `count` frames along the spine, y from −36 to 36 mm, slightly tilted.

    The middle frame of an odd count is the identity. Raises InvalidArgument for a negative count.
    """
    if count < 0:
        raise InvalidArgument(f"count must be at least 0, got {count}", field="count")
    u = np.linspace(-1.0, 1.0, count) if count > 1 else np.zeros(count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    swings_deg = (4.0 * np.sin(5.0 * u), 3.0 * np.sin(7.0 * u), 2.0 * np.sin(3.0 * u))  # about x, y, z
    about_x, about_y, about_z = (_rotations(axis, np.radians(swing)) for axis, swing in enumerate(swings_deg))
    poses[:, :3, :3] = about_x @ about_y @ about_z
    poses[:, 0, 3] = 1.5 * np.sin(4.0 * u)
    poses[:, 1, 3] = SWEEP_MM / 2 * u
    return check_poses(poses, field="poses")


def _rotations(axis: int, angle_rad: FloatArray) -> FloatArray:  # [C] -> [C, 3, 3]
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rotations = np.tile(np.eye(3), (len(angle_rad), 1, 1))
    rotations[:, i, i] = rotations[:, j, j] = np.cos(angle_rad)
    rotations[:, j, i] = np.sin(angle_rad)
    rotations[:, i, j] = -rotations[:, j, i]
    return rotations

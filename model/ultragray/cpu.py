"""The CPU backend: the C++ kernel of PHYSICS.md §5 behind the signature that all backends share."""

from __future__ import annotations

import torch

from .probe import ConvexProbe, FloatArray, Probe
from .reference import Fields
from .scene import GaussianScene
from . import reference


def supports(scene: GaussianScene) -> bool:
    return False


def render_fields(scene: GaussianScene, probe: Probe, poses_cm: FloatArray, height: int, width: int) -> Fields:
    return reference.render_fields(scene, probe, poses_cm, height, width)

"""Registrations of robots and trackers, as the service keeps them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .geometry import FloatArray


@dataclass(frozen=True, eq=False, kw_only=True)
class Registration:
    """How a robot lies to a scene: probe→scene = base_to_scene · flange→base · probe_to_flange.

    For a tracked probe the base is the tracker, and the flange the marker on the probe.
    """

    name: str
    scene: str
    base_to_scene: FloatArray  # [4, 4] mm
    probe_to_flange: FloatArray = field(default_factory=lambda: np.eye(4))  # [4, 4] mm
    residual_mm: float | None  # root mean square; None: not known
    residual_deg: float | None
    position_std_mm: tuple[float, float, float] | None  # standard deviations of base_to_scene, where it was found
    angle_std_deg: tuple[float, float, float] | None  # about the axes of the scene
    owner: str | None  # who put it
    changed_at: str  # ISO 8601, UTC

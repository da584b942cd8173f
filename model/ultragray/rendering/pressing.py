"""Tissue that gives way to a face that is pressed in, and to needles that are pushed in.

Under the face the displacement is that of elastic layers under a rigid punch of the face's outline, which touches where
the skin is before it and does not stick (model/kernels/pressing.hpp). Layers are the mean of the tissue under the
training views, by the stiffness of its labels (model/kernels/stiffness.hpp). Where a column of tissue is softer or
stiffer than its layer, it is compressed by as much more or less, and bone stays with all that lies behind it. Tissue
keeps its volume, so that it goes aside. What is returned displaces the scene (`ultragray.scene.deformation`);
`ultragray.rendering.frames` asks for it with what `contact` tells of the skin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from ultragray import _cpu
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.rendering.contact import Touch
from ultragray.rendering.tools import Needle, ScanView, Tool
from ultragray.scene.deformation import Displacement
from ultragray.scene.gaussians import GaussianScene


@dataclass(frozen=True, eq=False)
class Pressing:
    """What a face does to the tissue at C poses."""

    displacement: Displacement | None  # None: nothing moves
    indentation_mm: FloatArray  # [C] a mean over the scan lines with contact
    force_n: FloatArray  # [C] of the face, along its axis


class _Face(NamedTuple):
    """As the kernel takes it, mm."""

    depth: float
    breadth: float
    curved: bool
    far: float
    half_width: float

    @classmethod
    def of(cls, probe: Probe) -> _Face:
        depth, box = probe.face_depth_mm, probe.box_mm
        curved = probe.lines.unit == "deg" and depth > 0.0
        return cls(depth, probe.lines.breadth_mm(depth), curved, probe.far_mm, max(-box.left, box.right))


_PRESSES = 8  # of one scene, by the faces that its frames were asked with


def press(
    scene: GaussianScene,
    probe: Probe,
    poses: FloatArray,  # [C, 4, 4] mm
    touch: Touch,
    indentation_mm: float | None = None,
    tools: Sequence[Tool] = (),
) -> Pressing:
    """The tissue under a face at some poses, each pressed in as its `touch` tells, or by so much at all.

    Depth, layers and needles are taken as they are at the poses: gradients by poses hold the field where it is.
    """
    if indentation_mm is None:
        depths = touch.depths_mm
    else:
        depths = np.where(touch.lines.any(axis=1, keepdims=True), indentation_mm, np.zeros_like(touch.gaps_mm))
    needles = [tool for tool in tools if isinstance(tool, Needle)]
    view = ScanView(probe, poses, 1)
    shafts = np.stack([one.seen_by(view, (one.tip_mm, one.hub_mm)) for one in needles], axis=1) if needles else None
    figures = np.asarray(touch.mean(depths)), np.zeros(len(poses))
    if shafts is None:
        if not depths.any():
            return Pressing(None, *figures)
        shafts = np.zeros((len(poses), 0, 2, 3))
    kernel = _press_of(scene, _Face.of(probe))
    coefficients = np.empty((len(poses), *kernel.size, 3), np.float32)
    to_grid = np.empty((len(poses), 3, 4))
    kernel.at(
        poses=np.ascontiguousarray(scene.poses_at_rest(poses)),
        indentation_mm=np.ascontiguousarray(depths),
        needles_mm=np.ascontiguousarray(shafts),
        coefficients=coefficients,
        to_grid=to_grid,
        force_n=figures[1],
    )
    return Pressing(Displacement(torch.from_numpy(coefficients), to_grid), *figures)


def _press_of(scene: GaussianScene, face: _Face) -> _cpu.Press:
    def make() -> _cpu.Press:
        compliances = np.full(256, 1.0 / _cpu.stiffness_kpa(""), np.float32)
        for label, name in scene.info.label_names.items():
            compliances[label] = 1.0 / _cpu.stiffness_kpa(name)
        means = 10.0 * scene.means.detach().cpu().double().numpy() + np.asarray(scene.info.centre_mm)
        return _cpu.Press(
            means_mm=means.astype(np.float32),
            labels=None if scene.labels is None else scene.labels.cpu().numpy(),
            compliances=compliances,
            poses=np.ascontiguousarray(scene.at_rest().training_poses),
            **face._asdict(),
        )

    presses: dict[_Face, _cpu.Press] = scene.prepared("presses", dict)
    if face not in presses:
        if len(presses) >= _PRESSES:
            presses.clear()
        presses[face] = make()
    return presses[face]

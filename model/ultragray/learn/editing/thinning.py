"""Thinning: a scene keeps the Gaussians that show most in frames at its training poses."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ultragray.errors import InvalidArgument
from ultragray.learn.editing.parts import part
from ultragray.learn.sweep import spread_places
from ultragray.rendering.backends.inputs import beam_cm, scene_poses
from ultragray.rendering.backends.registry import BACKENDS, choose_backend
from ultragray.rendering.outputs import INTENSITY_SUM, WEIGHT_SUM
from ultragray.scene.edits import ThinEdit
from ultragray.scene.gaussians import GaussianScene

FRAMES, MAX_SIDE = 60, 128  # that importance is taken from; pixels of a side
_SLOPE = 0.28209479  # of the sum of intensities by the harmonic of degree 0, where each intensity is a half
_LEAST_SUM = 1.0 / 255.0


def thin(scene: GaussianScene, edit: ThinEdit) -> GaussianScene:
    """The most important Gaussians, as many as asked for. Raises InvalidArgument."""
    count = edit.gaussian_count
    if count is None:
        assert edit.file_bytes is not None
        values = sum(raw[0].numel() for raw in scene.splats.values())
        each = 4 * values + (scene.labels is not None)
        count = int((edit.file_bytes - len(scene.to_bytes()) + each * len(scene.means)) // each)
        if count < 1:
            raise InvalidArgument(f"file_bytes {edit.file_bytes} leaves room for no Gaussian", field="file_bytes")
    if count >= len(scene.means):
        return scene
    chosen = importance(scene).topk(count).indices.sort().values
    return part(scene, chosen)


def importance(scene: GaussianScene) -> Tensor:  # [N]
    """How much of B-mode each Gaussian makes in frames at training poses: as echo, and as what it takes from others.

    As echo: the sum over pixels of its share w/S of what is seen there, γ·T. As attenuation: the sum of what pixels
    would gain without it, E·∂T/∂τ·(1 − τ). Both are adjoints of the planes. Raises InvalidArgument for a scene without
    training poses or probe.
    """
    rest = scene.at_rest()
    probe = scene.info.probe
    if probe is None or not len(rest.training_poses):
        raise InvalidArgument("thin needs a scene that knows its training poses and its probe", field="kind")
    height, width = (min(side, MAX_SIDE) for side in scene.info.image_size_or(None, None))
    draw = BACKENDS[choose_backend("auto", scene)].draw
    importances = scene.means.new_zeros(len(scene.means))
    beam = beam_cm(scene.info.beam, probe)
    with torch.enable_grad():
        harmonics = torch.zeros_like(scene.sh0).requires_grad_()
        opacity = scene.transmittances.detach().clone().requires_grad_()
        splats: dict[str, Any] = {name: raw.detach() for name, raw in rest.splats.items()}
        splats |= {"sh0": harmonics, "shN": harmonics.detach()[:, :0], "transmittances": opacity}
        grey = GaussianScene(**splats, info=replace(rest.info, sh_degree=0, intensity="sigmoid", label_names={}))
        for place in spread_places(len(rest.training_poses), FRAMES):
            poses = scene_poses(rest, rest.training_poses[place])
            with torch.no_grad():
                echo = draw(rest, probe, poses, height, width, ("echo",), beam=beam)["echo"]
            planes = draw(grey, probe, poses, height, width, (WEIGHT_SUM, INTENSITY_SUM, "transmittance"), beam=beam)
            sums, transmittance = planes[WEIGHT_SUM].detach(), planes["transmittance"]
            share = torch.where(sums >= _LEAST_SUM, -torch.expm1(-sums) / sums.clamp(min=_LEAST_SUM), 0.0)
            seen = share * transmittance.detach()
            by_echo, by_opacity = torch.autograd.grad(
                (planes[INTENSITY_SUM], transmittance), (harmonics, opacity), (seen / _SLOPE, echo)
            )
            importances += by_echo.flatten().abs() + by_opacity.abs() / torch.sigmoid(opacity.detach()).clamp(min=1e-6)
    return importances.detach()

"""Scenes made from labels as the start of a training: what frames show is then recorded, and the rest stays as it was
made.
"""

from __future__ import annotations

from dataclasses import replace
from hashlib import sha256

import cv2
import numpy as np
import torch
from torch import Tensor

from ultragray.errors import InvalidArgument
from ultragray.geometry.probe import BoolArray, FloatArray
from ultragray.learn.editing.parts import as_sigmoid, means_mm
from ultragray.learn.labelling import with_labels
from ultragray.learn.sweep import Sweep
from ultragray.learn.training.config import TrainingConfig
from ultragray.scene.gaussians import PARAMETERS, GaussianScene
from ultragray.scene.info import expected_shapes

SHOWN_MM = 1.5  # from the plane of a frame: as near is what it shows


def started_parameters(start: GaussianScene, config: TrainingConfig, centre_mm: FloatArray) -> dict[str, Tensor]:
    """The raw parameters of a scene about the centre of a training, with as many harmonics as it has.

    Raises InvalidArgument where the training has other intensities.
    """
    if config.intensity != "sigmoid":
        raise InvalidArgument("intensity must be sigmoid where a training begins with a scene", field="intensity")
    scene = as_sigmoid(start.at_rest())
    splats = {name: scene.splats[name].detach().cpu().float().clone() for name in PARAMETERS}
    shift = (np.asarray(scene.info.centre_mm) - centre_mm) / 10.0
    splats["means"] += torch.from_numpy(shift).float()
    harmonics = torch.zeros(expected_shapes(len(scene.means), config.sh_degree)["shN"])
    same = min(harmonics.shape[1], splats["shN"].shape[1])
    harmonics[:, :same] = splats["shN"][:, :same]
    return {**splats, "shN": harmonics}


def with_labels_of(start: GaussianScene, scene: GaussianScene, sweep: Sweep) -> GaussianScene:
    """A trained scene with the labels of its start, each Gaussian that of the nearest there.

    What was made and no frame of the sweep shows stays among `made_labels`.
    """
    provenance = {
        "parents": {"start": sha256(start.to_bytes()).hexdigest()},
        "edits": start.info.provenance.get("edits", []),
    }
    scene = replace(scene, info=replace(scene.info, provenance=provenance))
    if start.labels is None:
        return scene
    places = means_mm(scene).astype(np.float32)
    index = cv2.flann.Index(means_mm(start).astype(np.float32), {"algorithm": 4, "leaf_max_size": 16})
    nearest, _ = index.knnSearch(places, 1, params={"checks": -1})
    labels = start.labels.cpu().numpy()[nearest[:, 0]]
    unrecorded = np.isin(labels, start.info.made_labels) & ~shown_by(sweep, places.astype(np.float64))
    return with_labels(scene, labels, start.info.label_names, unrecorded)


def shown_by(sweep: Sweep, places: FloatArray) -> BoolArray:  # [N, 3] mm -> [N]
    """The places that lie in the image of a frame, or nearly."""
    is_shown = np.zeros(len(places), bool)
    for pose in sweep.poses:
        local = (places - pose[:3, 3]) @ pose[:3, :3]
        near = np.flatnonzero(np.abs(local[:, 1]) < SHOWN_MM)
        rows, columns = sweep.probe.image_coordinates(local[near, 0], local[near, 2])
        is_shown[near[(rows >= 0.0) & (rows <= 1.0) & (columns >= 0.0) & (columns <= 1.0)]] = True
    return is_shown

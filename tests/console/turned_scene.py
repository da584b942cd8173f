"""Writes the demo scene in other axes: python turned_scene.py SCENE OUTPUT ANGLE_X ANGLE_Y ANGLE_Z (degrees)."""

import sys
from dataclasses import replace

import numpy as np
import torch

from ultragray import GaussianScene


def rotation(angles_deg):
    turned = np.eye(3)
    for axis, angle in enumerate(np.radians(angles_deg)):
        one = np.eye(3)
        a, b = [(1, 2), (2, 0), (0, 1)][axis]
        one[[a, a, b, b], [a, b, a, b]] = [np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)]
        turned = one @ turned
    return turned


def quaternion(matrix):
    _, vectors = np.linalg.eigh(_symmetric(matrix))
    return vectors[:, -1]


def _symmetric(m):
    """Of which the quaternion w, x, y, z of a rotation is the largest eigenvector (Bar-Itzhack)."""
    return np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[2, 0] + m[0, 2]],
            [m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], m[1, 1] - m[0, 0] - m[2, 2], m[2, 1] + m[1, 2]],
            [m[1, 0] - m[0, 1], m[2, 0] + m[0, 2], m[2, 1] + m[1, 2], m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )


def product(a, b):
    w, x, y, z = (float(value) for value in a)
    by = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    return b @ torch.tensor(by, dtype=b.dtype).T


source, output, *angles = sys.argv[1:]
scene = GaussianScene.load(source)
turn = rotation([float(angle) for angle in angles])
poses = np.array(scene.training_poses)
poses[:, :3] = turn @ poses[:, :3]
centre = turn @ np.asarray(scene.info.centre_mm)
means = scene.means @ torch.tensor(turn.T, dtype=scene.means.dtype)
splats = {**scene.splats, "means": means, "quats": product(quaternion(turn), scene.quats)}
info = replace(scene.info, centre_mm=tuple(centre.tolist()))
GaussianScene.from_splats(splats, info=info, training_poses=poses, labels=scene.labels).save(output)

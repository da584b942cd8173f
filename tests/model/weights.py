"""Weights of Gaussians in float64, all at all points: what slices, volumes and labels are compared with."""

import numpy as np


def gaussian_weights(scene, points_cm):  # [P, 3] -> [N, P]
    """w of every Gaussian at every point of the scene's own frame: its value in space, from its covariance."""
    means, scales, quats = (scene.splats[name].double().numpy() for name in ("means", "scales", "quats"))
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    axes = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)  # [N, 3, 3]
    inside = np.einsum("nij,nip->njp", axes, points_cm.T[None] - means[:, :, None]) / np.exp(scales)[:, :, None]
    return np.exp(-0.5 * (inside**2).sum(axis=1))

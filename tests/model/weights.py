"""Weights of Gaussians in float64, all at all points: what slices, volumes and labels are compared with."""

import numpy as np
from scipy.spatial.transform import Rotation


def gaussian_weights(scene, points_cm):  # [P, 3] -> [N, P]
    """w of every Gaussian at every point of the scene's own frame: its value in space, from its covariance."""
    means, scales, quats = (scene.splats[name].double().numpy() for name in ("means", "scales", "quats"))
    axes = Rotation.from_quat(np.roll(quats, -1, axis=1)).as_matrix()
    inside = np.einsum("nij,nip->njp", axes, points_cm.T[None] - means[:, :, None]) / np.exp(scales)[:, :, None]
    return np.exp(-0.5 * (inside**2).sum(axis=1))

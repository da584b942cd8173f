"""Rotations of many poses at once, the angles between them, and the transforms that they are part of."""

from __future__ import annotations

import math

import numpy as np

from ultragray.geometry.probe import FloatArray

_NO_TURN = 1e-300  # rad


def about_axes(axes: FloatArray, angles: FloatArray) -> FloatArray:  # [C, 3] of length 1, [C] rad -> [C, 3, 3]
    """Rodrigues' formula: 1 + sin a K + (1 − cos a) K²."""
    x, y, z = axes.T
    nothing = np.zeros_like(x)
    cross = np.stack([nothing, -z, y, z, nothing, -x, -y, x, nothing], axis=1).reshape(-1, 3, 3)
    sine, versine = np.sin(angles)[:, None, None], (1.0 - np.cos(angles))[:, None, None]
    rotations: FloatArray = np.eye(3) + sine * cross + versine * (cross @ cross)
    return rotations


def random_directions(random: np.random.Generator, count: int) -> FloatArray:  # [C, 3]
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions


def blended(first: FloatArray, second: FloatArray, shares: FloatArray) -> FloatArray:  # [C, 3, 3] both, [C]
    """The rotations [C, 3, 3] on the shortest way from the first (share 0) to the second (1), at even speed (slerp)."""
    relative = first.transpose(0, 2, 1) @ second
    axes, angles = _axes_and_angles(relative)
    return first @ about_axes(axes, shares * angles)


def rotations_of(turns: FloatArray) -> FloatArray:  # [C, 3] rad -> [C, 3, 3]
    angles = np.linalg.norm(turns, axis=1)
    return about_axes(turns / np.maximum(angles, _NO_TURN)[:, None], angles)


def turns_of(rotations: FloatArray) -> FloatArray:  # [C, 3, 3] -> [C, 3] rad
    """Axis times angle, at most π, of each rotation."""
    axes, angles = _axes_and_angles(rotations)
    return axes * angles[:, None]


def transforms_of(rotations: FloatArray, shifts: FloatArray) -> FloatArray:  # [..., 3, 3], [..., 3] -> [..., 4, 4]
    """The transforms that first rotate and then shift; shapes broadcast."""
    transforms = np.zeros((*np.broadcast_shapes(rotations.shape[:-2], shifts.shape[:-1]), 4, 4))
    transforms[..., :3, :3], transforms[..., :3, 3], transforms[..., 3, 3] = rotations, shifts, 1.0
    return transforms


def rotation_angles_deg(poses: FloatArray, others: FloatArray) -> FloatArray:  # [C, 4, 4], [P, 4, 4] -> [C, P]
    """Angle of the rotation from one probe orientation to the other, in degrees."""
    return np.degrees(turn_angles_rad(poses[:, None, :3, :3], others[None, :, :3, :3]))


def turn_angles_rad(rotations: FloatArray, others: FloatArray) -> FloatArray:  # [..., 3, 3] both -> [...]
    """Angle of the rotation from one to the other; shapes broadcast."""
    half_chords = np.linalg.norm(rotations - others, axis=(-2, -1)) / math.sqrt(8.0)  # sin(angle / 2)
    radians: FloatArray = 2.0 * np.arcsin(np.clip(half_chords, 0.0, 1.0))
    return radians


def mean_axes(poses: FloatArray) -> FloatArray:  # [F, 4, 4] -> [3, 3]
    """The rotation nearest to the mean of the poses' rotations."""
    left, _, right = np.linalg.svd(poses[:, :3, :3].mean(axis=0))
    rotation: FloatArray = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return rotation


def _axes_and_angles(rotations: FloatArray) -> tuple[FloatArray, FloatArray]:  # [C, 3, 3] -> [C, 3], [C] rad in [0, π]
    r = rotations
    trace = np.trace(r, axis1=1, axis2=2)
    antisymmetric = np.stack([r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], axis=1)
    products = np.empty((len(r), 4, 4))  # of the components of a quaternion, four times each
    products[:, 0, 0] = 1.0 + trace
    products[:, 0, 1:] = products[:, 1:, 0] = antisymmetric
    products[:, 1:, 1:] = r + r.transpose(0, 2, 1) + (1.0 - trace)[:, None, None] * np.eye(3)
    largest = np.diagonal(products, axis1=1, axis2=2).argmax(axis=1)
    quaternions = products[np.arange(len(r)), largest]
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    quaternions *= np.where(quaternions[:, :1] < 0.0, -1.0, 1.0)
    sines = np.linalg.norm(quaternions[:, 1:], axis=1)  # of half the angle
    angles = 2.0 * np.arctan2(sines, quaternions[:, 0])
    still = sines == 0.0
    axes = np.where(still[:, None], [1.0, 0.0, 0.0], quaternions[:, 1:] / np.where(still, 1.0, sines)[:, None])
    return axes, angles

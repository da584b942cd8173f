"""One scan line across one slice, and the absorption along it (docs/physics.md §3, §8)."""

import triton
import triton.language as tl

from ultragray.backends.cuda.kernels.constants import (
    FULL_PROFILE,
    HALF_LOG2_E,
    MAX_M2,
    MAX_M2_ATTENUATION,
    MIN_VARIANCE_CM2,
    NODE,
)


@triton.jit
def bell(x):
    """exp(-x2 / 2)"""
    return tl.exp2((x * x) * -HALF_LOG2_E)


@triton.jit
def polynomial_profile(u):
    """G(u) of §3 where depth 0 does not clip its window, within 3.2e-4, and exact from u = 3 on, where it is constant:
    whether a crossed Gaussian counts decides over the rest of its scan line."""
    v = (tl.minimum(tl.maximum(u, -3.34), 3.0) + 0.17) * 0.31545741324921134
    p = -1.17912165 * v - 1.08363338
    p = p * v + 4.49129112
    p = p * v + 4.48426945
    p = p * v - 6.86307471
    p = p * v - 8.09939924
    p = p * v + 5.18377769
    p = p * v + 8.18838
    p = p * v - 2.00312422
    p = p * v - 5.11385445
    p = p * v + 0.737662447
    p = p * v + 3.06877651
    return tl.where(u >= 3.0, FULL_PROFILE, p * v + 1.0784183)


@triton.jit
def clipped_profile(u, zero):
    """G where depth 0, at u = zero, clips the window (or not): the three-point Gauss-Legendre rule itself."""
    centre = tl.minimum(tl.maximum(zero, 0.0), u)
    low, high = tl.maximum(centre - 3.0, zero), tl.minimum(centre + 3.0, u)
    half, middle = 0.5 * (high - low), 0.5 * (high + low)
    before, after = middle - NODE * half, middle + NODE * half
    total = 0.8888888888888888 * bell(middle) + 0.5555555555555556 * (bell(before) + bell(after))
    depth = u - zero
    degenerate = (depth * depth <= 1e-8) | (high <= low)
    return tl.where(degenerate, depth * bell(0.5 * (u + zero)), half * total)


@triton.jit
def profile_slopes(u, zero):
    """G, and its derivatives by u and by `zero`."""
    start = tl.maximum(zero, 0.0)
    above = u <= start  # the centre of the window is at u itself
    centre = tl.minimum(start, u)
    centre_by_u = tl.where(above, 1.0, 0.0)
    centre_by_zero = tl.where(above | (zero < 0.0), 0.0, 1.0)
    cut, opened = centre - 3.0 <= zero, u <= centre + 3.0
    low, high = tl.maximum(centre - 3.0, zero), tl.minimum(centre + 3.0, u)
    low_by_u, low_by_zero = tl.where(cut, 0.0, centre_by_u), tl.where(cut, 1.0, centre_by_zero)
    high_by_u, high_by_zero = tl.where(opened, 1.0, centre_by_u), tl.where(opened, 0.0, centre_by_zero)

    half, middle = 0.5 * (high - low), 0.5 * (high + low)
    before, after = middle - NODE * half, middle + NODE * half
    at_middle = 0.8888888888888888 * bell(middle)
    at_before, at_after = 0.5555555555555556 * bell(before), 0.5555555555555556 * bell(after)
    total = at_middle + at_before + at_after
    by_middle = -half * (middle * at_middle + before * at_before + after * at_after)
    by_half = total - half * NODE * (after * at_after - before * at_before)
    by_low, by_high = 0.5 * (by_middle - by_half), 0.5 * (by_middle + by_half)

    depth, point = u - zero, 0.5 * (u + zero)
    density = bell(point)
    degenerate = (depth * depth <= 1e-8) | (high <= low)
    bend = 0.5 * depth * point * density
    value = tl.where(degenerate, depth * density, half * total)
    by_u = tl.where(degenerate, density - bend, by_low * low_by_u + by_high * high_by_u)
    by_zero = tl.where(degenerate, -density - bend, by_low * low_by_zero + by_high * high_by_zero)
    return value, by_u, by_zero


@triton.jit
def shortest_turn(turn, width, WRAP: tl.constexpr):
    """From one scan line to another, in lines: the shorter way round where they go all the way."""
    if WRAP:
        return turn - width * tl.floor(turn / width + 0.5)
    else:
        return turn


@triton.jit
def cross(turn, t, row_offset, r, m2_plane, tt, tr, rr, det, pitch, FANNED: tl.constexpr):
    """Scan lines `turn` lines to the right of a slice's own: how they cross the slice.

    Returns the line's direction in the slice's axes, its distance across from the mean and one over the variance in
    that direction, m2, sigma along the line (cm), how far the slice's own row lies past s*, s*, and whether w reaches
    1/255.
    """
    if FANNED:
        angle = turn * pitch
        dx, dz = tl.sin(angle), tl.cos(angle)
        half = tl.sin(0.5 * angle)
        fallen = 2.0 * half * half  # 1 - cos, to the last digit
        across = dx * r - dz * t
        variance_across = dx * dx * rr - 2.0 * dx * dz * tr + dz * dz * tt
        tilt = dx * dz * (rr - tt) + tr * (dx * dx - dz * dz)
        lag = fallen * r - dx * t  # the mean lies at r - lag along the line
    else:
        dx, dz = turn * 0.0, turn * 0.0 + 1.0
        across = turn * pitch - t
        variance_across = tt + turn * 0.0
        tilt = -tr
        lag = turn * 0.0
    inverse = 1.0 / variance_across
    shift = tilt * across * inverse
    past = row_offset + lag + shift
    star = r - lag - shift
    m2 = m2_plane + across * across * inverse
    variance = det * inverse
    touched = (m2 <= MAX_M2) & (variance >= MIN_VARIANCE_CM2)
    sigma = tl.sqrt(tl.where(touched, variance, 1.0))
    return dx, dz, across, inverse, m2, sigma, past, star, touched


@triton.jit
def peak_of(m2, sigma, touched):
    """psi = peak * G(u)."""
    return tl.where(touched & (m2 <= MAX_M2_ATTENUATION), tl.exp2(m2 * -HALF_LOG2_E) * sigma, 0.0)

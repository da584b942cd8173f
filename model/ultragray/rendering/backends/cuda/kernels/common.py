"""What the kernels share: constants of the model (docs/physics.md §3), profiles along a line, spherical harmonics."""

import triton
import triton.language as tl

MAX_M2 = tl.constexpr(11.0825270903)  # -2 log(1/255): w and alpha are under 1/255 beyond
MAX_M2_ATTENUATION = tl.constexpr(9.0)
MAX_WEIGHT = tl.constexpr(0.999)
MIN_PSI = tl.constexpr(0.0039292930)  # -log(1 - 1/255): alpha reaches 1/255
FULL_PROFILE = tl.constexpr(2.8906850)  # G(u) for u >= 3
NEGLIGIBLE = tl.constexpr(24.0)  # w < 7e-6 beyond m2 + u2: dozens of such tails on a pixel still do not show
EARLY_SIGMA_CM = tl.constexpr(1.8)  # an opaque Gaussian wider than this absorbs 1/255 above the rows where w does
MIN_VARIANCE_CM2 = tl.constexpr(1e-32)  # thinner ones touch no row
LOG2_E = tl.constexpr(1.4426950408889634)  # the hardware's exponential has base 2
HALF_LOG2_E = tl.constexpr(0.7213475204444817)  # exp(-x2 / 2) is exp2(-HALF_LOG2_E x2)
NODE = tl.constexpr(0.7745966692414834)  # Gauss-Legendre: nodes 0, +-sqrt(0.6)

# Of a pose: axes 9, origin 3, near, cull_far, row_cm, start and span of the scan lines, and the beam's variance by
# depth: at the focus, the focus, the square of its slope, the most.
VIEW = tl.constexpr(21)
FIELDS = tl.constexpr(12)  # of a slice: t, row offset, r, m2, tt, tr, rr, det, intensity, 1 - tau; to whole 16 bytes
RECTANGLE = tl.constexpr(8)  # of a slice: first and last column and row, own column and row, clipped; likewise
GRADIENTS = tl.constexpr(9)  # by a slice's t, r, tt, tr, rr, m2, intensity, 1 - tau, det
SPARE_LINES = tl.constexpr(15)  # what a footprint costs beside its pixels, as on the CPU (model/kernels/footprint.cpp)
SPARE_ROWS = tl.constexpr(16)
CLIPPED_COST = tl.constexpr(8)
NOTHING = tl.constexpr(1 << 30)  # larger than every block, row and column


# One scan line across one slice, and the absorption along it (docs/physics.md §3, §8).


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


# A Gaussian's echo intensity for a probe, as kernels compute it (docs/physics.md §2), and its derivative.


@triton.jit
def direction(x, y, z):
    """The unit vector, 0 where there is none, and one over the length."""
    squared = x * x + y * y + z * z
    inverse = 1.0 / tl.sqrt(tl.maximum(squared, 1e-36))
    return x * inverse, y * inverse, z * inverse, inverse


@triton.jit
def coefficient(shn, stride, index, mask, term: tl.constexpr):
    return tl.load(shn + index * stride + (term - 1), mask, 0.0)


@triton.jit
def harmonics(ox, oy, oz, sh0, shn, stride, index, mask, DEGREE: tl.constexpr):
    """The sum of the harmonics seen along an offset from the probe."""
    x, y, z, _ = direction(ox, oy, oz)
    value = 0.28209479177387814 * tl.load(sh0 + index, mask, 0.0)
    if DEGREE >= 1:
        value += 0.4886025119029199 * (
            z * coefficient(shn, stride, index, mask, 2)
            - y * coefficient(shn, stride, index, mask, 1)
            - x * coefficient(shn, stride, index, mask, 3)
        )
    if DEGREE >= 2:
        value += 1.0925484305920792 * (
            x * y * coefficient(shn, stride, index, mask, 4)
            - y * z * coefficient(shn, stride, index, mask, 5)
            - x * z * coefficient(shn, stride, index, mask, 7)
        )
        value += 0.31539156525252005 * (2.0 * z * z - x * x - y * y) * coefficient(shn, stride, index, mask, 6)
        value += 0.5462742152960396 * (x * x - y * y) * coefficient(shn, stride, index, mask, 8)
    if DEGREE >= 3:
        value -= 0.5900435899266435 * (
            y * (3.0 * x * x - y * y) * coefficient(shn, stride, index, mask, 9)
            + x * (x * x - 3.0 * y * y) * coefficient(shn, stride, index, mask, 15)
        )
        value += 2.890611442640554 * x * y * z * coefficient(shn, stride, index, mask, 10)
        value -= (
            0.4570457994644658
            * (4.0 * z * z - x * x - y * y)
            * (y * coefficient(shn, stride, index, mask, 11) + x * coefficient(shn, stride, index, mask, 13))
        )
        value += (
            0.3731763325901154
            * z
            * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y)
            * coefficient(shn, stride, index, mask, 12)
        )
        value += 1.445305721320277 * z * (x * x - y * y) * coefficient(shn, stride, index, mask, 14)
    return value


@triton.jit
def activate(value, SIGMOID: tl.constexpr):
    if SIGMOID:
        return tl.sigmoid(4.0 * value)
    else:
        return tl.minimum(tl.maximum(value + 1.0, 0.5), 0.999)


@triton.jit
def harmonics_gradient(
    ox,
    oy,
    oz,
    sh0,
    shn,
    stride,
    index,
    mask,
    on_intensity,
    DEGREE: tl.constexpr,
    SIGMOID: tl.constexpr,
    TERMS: tl.constexpr,
):
    """Gradients of intensity: by the mean, through the direction of view, and by each coefficient, [N, TERMS]."""
    value = harmonics(ox, oy, oz, sh0, shn, stride, index, mask, DEGREE)
    activated = activate(value, SIGMOID)
    if SIGMOID:
        on_value = on_intensity * 4.0 * activated * (1.0 - activated)
    else:
        on_value = tl.where((value + 1.0 >= 0.5) & (value + 1.0 <= 0.999), on_intensity, 0.0)
    x, y, z, inverse = direction(ox, oy, oz)
    term = tl.arange(0, TERMS)[None, :]
    basis = tl.where(term == 0, 0.28209479177387814, 0.0)
    gx, gy, gz = x * 0.0, x * 0.0, x * 0.0
    if DEGREE >= 1:
        k: tl.constexpr = 0.4886025119029199
        basis = column(basis, term, 1, -k * y)
        basis = column(basis, term, 2, k * z)
        basis = column(basis, term, 3, -k * x)
        gx -= k * coefficient(shn, stride, index, mask, 3)
        gy -= k * coefficient(shn, stride, index, mask, 1)
        gz += k * coefficient(shn, stride, index, mask, 2)
    if DEGREE >= 2:
        m: tl.constexpr = 1.0925484305920792
        n: tl.constexpr = 0.31539156525252005
        basis = column(basis, term, 4, m * x * y)
        basis = column(basis, term, 5, -m * y * z)
        basis = column(basis, term, 6, n * (2.0 * z * z - x * x - y * y))
        basis = column(basis, term, 7, -m * x * z)
        basis = column(basis, term, 8, 0.5 * m * (x * x - y * y))
        c4, c5 = coefficient(shn, stride, index, mask, 4), coefficient(shn, stride, index, mask, 5)
        c6, c7 = coefficient(shn, stride, index, mask, 6), coefficient(shn, stride, index, mask, 7)
        c8 = coefficient(shn, stride, index, mask, 8)
        gx += m * (y * c4 - z * c7 + x * c8) - 2.0 * n * x * c6
        gy += m * (x * c4 - z * c5 - y * c8) - 2.0 * n * y * c6
        gz += 4.0 * n * z * c6 - m * (y * c5 + x * c7)
    if DEGREE >= 3:
        a: tl.constexpr = 0.5900435899266435
        b: tl.constexpr = 2.890611442640554
        d: tl.constexpr = 0.4570457994644658
        e: tl.constexpr = 0.3731763325901154
        xx, yy, zz = x * x, y * y, z * z
        basis = column(basis, term, 9, -a * y * (3.0 * xx - yy))
        basis = column(basis, term, 10, b * x * y * z)
        basis = column(basis, term, 11, -d * y * (4.0 * zz - xx - yy))
        basis = column(basis, term, 12, e * z * (2.0 * zz - 3.0 * xx - 3.0 * yy))
        basis = column(basis, term, 13, -d * x * (4.0 * zz - xx - yy))
        basis = column(basis, term, 14, 0.5 * b * z * (xx - yy))
        basis = column(basis, term, 15, -a * x * (xx - 3.0 * yy))
        c9, c10 = coefficient(shn, stride, index, mask, 9), coefficient(shn, stride, index, mask, 10)
        c11, c12 = coefficient(shn, stride, index, mask, 11), coefficient(shn, stride, index, mask, 12)
        c13, c14 = coefficient(shn, stride, index, mask, 13), coefficient(shn, stride, index, mask, 14)
        c15 = coefficient(shn, stride, index, mask, 15)
        gx += b * (y * z * c10 + x * z * c14) - 6.0 * a * x * y * c9 - 3.0 * a * (xx - yy) * c15
        gx += d * (2.0 * x * y * c11 - (4.0 * zz - 3.0 * xx - yy) * c13) - 6.0 * e * x * z * c12
        gy += b * (x * z * c10 - y * z * c14) + 6.0 * a * x * y * c15 - 3.0 * a * (xx - yy) * c9
        gy += d * (2.0 * x * y * c13 - (4.0 * zz - xx - 3.0 * yy) * c11) - 6.0 * e * y * z * c12
        gz += b * (x * y * c10 + 0.5 * (xx - yy) * c14) - 8.0 * d * z * (y * c11 + x * c13)
        gz += e * (6.0 * zz - 3.0 * xx - 3.0 * yy) * c12
    radial = x * gx + y * gy + z * gz  # turning the direction does not change its length
    rate = tl.where(inverse <= 1e15, on_value * inverse, 0.0)  # at the probe's own origin there is no direction
    return rate * (gx - x * radial), rate * (gy - y * radial), rate * (gz - z * radial), basis * on_value[:, None]


@triton.jit
def column(matrix, term, number: tl.constexpr, values):
    """[N, TERMS] with [N] values in one column."""
    return tl.where(term == number, values[:, None], matrix)

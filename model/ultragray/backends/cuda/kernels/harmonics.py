"""A Gaussian's echo intensity for a probe, as kernels compute it (docs/physics.md §2), and its derivative."""

import triton
import triton.language as tl


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

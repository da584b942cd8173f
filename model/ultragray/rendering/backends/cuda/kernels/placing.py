"""The last step of the backward pass: from slices to the raw parameters of their Gaussians, over all poses.

One program owns BLOCK Gaussians and adds up what each pose says of them, pose after pose.

What is derived. `gathering` leaves the gradient of the loss L by each slice, the 2D Gaussian that a Gaussian leaves in
the image plane: by its mean and covariance along and across the slice's own scan line, by m², by the determinant of its
covariance, by intensity and absorption. Here this becomes the gradient by the raw parameters (docs/physics.md §2). All
is in the axes of the probe (x lateral, y elevation, z axial; sheared for steered lines) about its origin, in cm, until
`towards_scene` turns vectors into the scene's axes. on_x stands for ∂L/∂x, and so on.

The equations, forwards (`slicing`; §3). μ is the mean, and Σ = a aᵀ + b bᵀ + c cᵀ, where the spokes a, b, c are the
columns of the rotation R, each times its standard deviation s_k. A beam adds its variance to Σ_yy at first, and
ln(1 + variance·eᵀΣ⁻¹e) to m² (`spread_along_elevation`). The plane y = 0 then cuts out, with the tilts t_x = Σ_xy/Σ_yy
and t_z = Σ_yz/Σ_yy and the rise r = μ_y/Σ_yy,

    mean (μ_x − t_x·μ_y, μ_z − t_z·μ_y)      m² = r·μ_y
    covariance (Σ_xx − t_x·Σ_xy, Σ_xz − t_x·Σ_yz, Σ_zz − t_z·Σ_yz)

Backwards, in the order of the code: turn the gradient from the axes of a fan's scan line into the probe's; add to the
covariance's what the determinant says; undo the cut (the six entries of Σ and the three of μ); undo the beam, whose
variance depends on the depth of μ, and whose moments are those that `Moments` of `backends.inputs` takes; from Σ to the
spokes (∂L/∂a = (G + Gᵀ)·a), from these to log s_k (a·∂L/∂a) and R, and on to the unit quaternion, less the part along
it; to μ and, by way of the direction of view, to the harmonics; and last to a shift and a turn of the whole view, which
move all Gaussians the other way (§4).
"""

import triton
import triton.language as tl

from ultragray.rendering.backends.cuda.kernels.common import GRADIENTS, RECTANGLE, VIEW, harmonics_gradient
from ultragray.rendering.backends.cuda.kernels.slicing import place, spread_along_elevation


@triton.jit
def towards_scene(view, x, y, z, axis: tl.constexpr):
    """The scene's component `axis` of a vector in the probe's axes."""
    return tl.load(view + axis) * x + tl.load(view + 3 + axis) * y + tl.load(view + 6 + axis) * z


@triton.jit
def spoke_gradient(spoke, on_xx, on_xy, on_xz, on_yy, on_yz, on_zz):
    """By an axis times its standard deviation, from that by the covariance, their sum of outer products."""
    return (
        2.0 * spoke[0] * on_xx + spoke[1] * on_xy + spoke[2] * on_xz,
        2.0 * spoke[1] * on_yy + spoke[0] * on_xy + spoke[2] * on_yz,
        2.0 * spoke[2] * on_zz + spoke[0] * on_xz + spoke[1] * on_yz,
    )


@triton.jit
def store_sums(to, x, y, z):
    """A vector, over all Gaussians, negative: to move the probe is to move them the other way."""
    tl.store(to, -tl.sum(x, 0))
    tl.store(to + 1, -tl.sum(y, 0))
    tl.store(to + 2, -tl.sum(z, 0))


@triton.jit
def store3(to, index, mask, x, y, z):
    tl.store(to + index * 3, x.to(tl.float32), mask)
    tl.store(to + index * 3 + 1, y.to(tl.float32), mask)
    tl.store(to + index * 3 + 2, z.to(tl.float32), mask)


@triton.jit(do_not_specialize=["poses", "count", "shn_stride", "width"])
def place_gradients(
    views,
    means,
    scales,
    quats,
    transmittances,
    sh0,
    shn,
    rectangles,
    counts,
    places,
    gradients,  # [C, B, BLOCK, GRADIENTS], by slices
    by_means,  # [N, 3] out, as are the others, in the shapes of what they are named after
    by_scales,
    by_quats,
    by_transmittances,
    by_sh0,
    by_shn,  # [N, K - 1] contiguous
    by_views,  # [C, B, 2, 3] float64 out: by a shift and a turn of the view; only where BY_VIEW
    by_beam,  # [B, 3] float64 out: by the beam's variance, times powers of the depth's offset from the focus
    poses,
    count,
    shn_stride,
    width,
    FANNED: tl.constexpr,
    SIGMOID: tl.constexpr,
    DEGREE: tl.constexpr,
    THICK: tl.constexpr,
    WEIGHTED: tl.constexpr,
    TERMS: tl.constexpr,  # coefficients, to the next power of two
    BY_VIEW: tl.constexpr,
    BLOCK: tl.constexpr,
):
    block, blocks = tl.program_id(0), tl.num_programs(0)
    lanes = tl.arange(0, BLOCK)
    index = block * BLOCK + lanes
    mask = index < count
    zero = tl.zeros([BLOCK], tl.float32)
    sum_mx, sum_my, sum_mz = zero, zero, zero
    sum_s0, sum_s1, sum_s2 = zero, zero, zero
    sum_qw, sum_qx, sum_qy, sum_qz = zero, zero, zero, zero
    sum_absorb = zero
    sum_sh = tl.zeros([BLOCK, TERMS], tl.float32)
    zeroth, first, second = tl.zeros([BLOCK], tl.float64), tl.zeros([BLOCK], tl.float64), tl.zeros([BLOCK], tl.float64)
    for pose in range(0, poses):
        group = pose * blocks + block.to(tl.int64)
        if tl.load(counts + group) > 0:
            view = views + pose * VIEW
            rank = tl.load(places + group * BLOCK + lanes)
            cut = rank >= 0
            slot = group * BLOCK + rank
            g = gradients + slot * GRADIENTS
            on_t, on_r = tl.load(g, cut, 0.0).to(tl.float64), tl.load(g + 1, cut, 0.0).to(tl.float64)
            on_tt, on_tr = tl.load(g + 2, cut, 0.0).to(tl.float64), tl.load(g + 3, cut, 0.0).to(tl.float64)
            on_rr, on_m2 = tl.load(g + 4, cut, 0.0).to(tl.float64), tl.load(g + 5, cut, 0.0).to(tl.float64)
            # The gradient by the slice, turned from the axes of its scan line to those of the probe.
            if FANNED:
                start, pitch = tl.load(view + 15), tl.load(view + 16) / width
                column = tl.load(rectangles + slot * RECTANGLE + 4, cut, 0)
                theta = start + (column.to(tl.float64) + 0.5) * pitch
                dx, dz = tl.sin(theta), tl.cos(theta)
                on_x, on_z = dz * on_t + dx * on_r, dz * on_r - dx * on_t
                on_xx = dz * dz * on_tt + dx * dz * on_tr + dx * dx * on_rr
                on_xz = 2.0 * dx * dz * (on_rr - on_tt) + (dz * dz - dx * dx) * on_tr
                on_zz = dx * dx * on_tt - dx * dz * on_tr + dz * dz * on_rr
            else:
                on_x, on_z, on_xx, on_xz, on_zz = on_t, on_r, on_tt, on_tr, on_rr

            offset, mean, a, b, c, q, norm, s = place(view, means, scales, quats, index, cut)
            xx = a[0] * a[0] + b[0] * b[0] + c[0] * c[0]
            xy = a[0] * a[1] + b[0] * b[1] + c[0] * c[1]
            xz = a[0] * a[2] + b[0] * b[2] + c[0] * c[2]
            yy = a[1] * a[1] + b[1] * b[1] + c[1] * c[1]
            yz = a[1] * a[2] + b[1] * b[2] + c[1] * c[2]
            zz = a[2] * a[2] + b[2] * b[2] + c[2] * c[2]
            if THICK:
                depth_offset, variance, precision, ratio = spread_along_elevation(view, mean, a, b, c, s, FANNED)
                yy += variance
            # The cut by the plane, backwards, after what the determinant of the slice's covariance says.
            inverse = 1.0 / yy
            rise, tilt_x, tilt_z = mean[1] * inverse, xy * inverse, yz * inverse
            on_det = tl.load(g + 8, cut, 0.0).to(tl.float64)
            on_xx += on_det * (zz - yz * tilt_z)
            on_xz -= 2.0 * on_det * (xz - xy * tilt_z)
            on_zz += on_det * (xx - xy * tilt_x)
            on_y = 2.0 * rise * on_m2 - tilt_x * on_x - tilt_z * on_z
            on_xy = -2.0 * tilt_x * on_xx - tilt_z * on_xz - rise * on_x
            on_yz = -2.0 * tilt_z * on_zz - tilt_x * on_xz - rise * on_z
            on_yy = tilt_x * tilt_x * on_xx + tilt_x * tilt_z * on_xz + tilt_z * tilt_z * on_zz
            on_yy += rise * (tilt_x * on_x + tilt_z * on_z) - rise * rise * on_m2

            # The beam, backwards: m² and Σ_yy hold its variance, which depends on the depth of the mean.
            on_px, on_pz = on_x, on_z
            if THICK:
                on_variance = tl.where(cut, on_yy + on_m2 * precision / ratio, 0.0)
                zeroth += on_variance
                first += on_variance * depth_offset
                second += on_variance * depth_offset * depth_offset
                on_depth = 2.0 * tl.load(view + 19) * on_variance * depth_offset
                if FANNED:
                    depth = depth_offset + tl.load(view + 18)
                    on_px += on_depth * mean[0] / depth
                    on_pz += on_depth * mean[2] / depth
                else:
                    on_pz += on_depth

            # From Σ to the spokes, and from these to the logs of the standard deviations.
            ga = spoke_gradient(a, on_xx, on_xy, on_xz, on_yy, on_yz, on_zz)
            gb = spoke_gradient(b, on_xx, on_xy, on_xz, on_yy, on_yz, on_zz)
            gc = spoke_gradient(c, on_xx, on_xy, on_xz, on_yy, on_yz, on_zz)
            if THICK:  # eᵀΣ⁻¹e is the sum of (spoke / s²)² along elevation
                on_precision = on_m2 * variance / ratio
                pa = 2.0 * on_precision * a[1] / (s[0] * s[0] * s[0] * s[0])
                pb = 2.0 * on_precision * b[1] / (s[1] * s[1] * s[1] * s[1])
                pc = 2.0 * on_precision * c[1] / (s[2] * s[2] * s[2] * s[2])
                sum_s0 -= tl.where(cut, 2.0 * pa * a[1], 0.0).to(tl.float32)
                sum_s1 -= tl.where(cut, 2.0 * pb * b[1], 0.0).to(tl.float32)
                sum_s2 -= tl.where(cut, 2.0 * pc * c[1], 0.0).to(tl.float32)
                ga = (ga[0], ga[1] + pa, ga[2])
                gb = (gb[0], gb[1] + pb, gb[2])
                gc = (gc[0], gc[1] + pc, gc[2])
            sum_s0 += tl.where(cut, ga[0] * a[0] + ga[1] * a[1] + ga[2] * a[2], 0.0).to(tl.float32)
            sum_s1 += tl.where(cut, gb[0] * b[0] + gb[1] * b[1] + gb[2] * b[2], 0.0).to(tl.float32)
            sum_s2 += tl.where(cut, gc[0] * c[0] + gc[1] * c[1] + gc[2] * c[2], 0.0).to(tl.float32)

            # From the spokes to the rotation, and its quaternion. Of r01: the scene's axis, and the Gaussian's own.
            r00 = s[0] * towards_scene(view, ga[0], ga[1], ga[2], 0)
            r10 = s[0] * towards_scene(view, ga[0], ga[1], ga[2], 1)
            r20 = s[0] * towards_scene(view, ga[0], ga[1], ga[2], 2)
            r01 = s[1] * towards_scene(view, gb[0], gb[1], gb[2], 0)
            r11 = s[1] * towards_scene(view, gb[0], gb[1], gb[2], 1)
            r21 = s[1] * towards_scene(view, gb[0], gb[1], gb[2], 2)
            r02 = s[2] * towards_scene(view, gc[0], gc[1], gc[2], 0)
            r12 = s[2] * towards_scene(view, gc[0], gc[1], gc[2], 1)
            r22 = s[2] * towards_scene(view, gc[0], gc[1], gc[2], 2)
            w, x, y, z = q[0], q[1], q[2], q[3]
            gw = 2.0 * (x * (r21 - r12) + y * (r02 - r20) + z * (r10 - r01))
            gx = 2.0 * (w * (r21 - r12) + y * (r01 + r10) + z * (r02 + r20) - 2.0 * x * (r11 + r22))
            gy = 2.0 * (w * (r02 - r20) + x * (r01 + r10) + z * (r12 + r21) - 2.0 * y * (r00 + r22))
            gz = 2.0 * (w * (r10 - r01) + x * (r02 + r20) + y * (r12 + r21) - 2.0 * z * (r00 + r11))
            radial = w * gw + x * gx + y * gy + z * gz  # a longer quaternion is the same rotation
            sum_qw += tl.where(cut, (gw - w * radial) / norm, 0.0).to(tl.float32)
            sum_qx += tl.where(cut, (gx - x * radial) / norm, 0.0).to(tl.float32)
            sum_qy += tl.where(cut, (gy - y * radial) / norm, 0.0).to(tl.float32)
            sum_qz += tl.where(cut, (gz - z * radial) / norm, 0.0).to(tl.float32)

            # The intensity, by the direction of view; then the mean, the absorption, and the view as a whole.
            vx, vy, vz = offset[0].to(tl.float32), offset[1].to(tl.float32), offset[2].to(tl.float32)
            on_intensity = tl.load(g + 6, cut, 0.0)
            hx, hy, hz, on_sh = harmonics_gradient(
                vx, vy, vz, sh0, shn, shn_stride, index, cut, on_intensity, DEGREE, SIGMOID, TERMS
            )
            sum_sh += on_sh
            on_mx = tl.where(cut, towards_scene(view, on_px, on_y, on_pz, 0), 0.0)
            on_my = tl.where(cut, towards_scene(view, on_px, on_y, on_pz, 1), 0.0)
            on_mz = tl.where(cut, towards_scene(view, on_px, on_y, on_pz, 2), 0.0)
            sum_mx += on_mx.to(tl.float32) + hx
            sum_my += on_my.to(tl.float32) + hy
            sum_mz += on_mz.to(tl.float32) + hz
            if WEIGHTED:  # by the log of the weight, which moves m2 by -2
                sum_absorb -= 2.0 * tl.load(g + 5, cut, 0.0)
            else:
                sum_absorb += tl.load(g + 7, cut, 0.0)
            if BY_VIEW:
                # A turn of the probe about its origin changes no intensity.
                tx = offset[1] * on_mz - offset[2] * on_my + 0.5 * (w * gx - x * gw + y * gz - z * gy)
                ty = offset[2] * on_mx - offset[0] * on_mz + 0.5 * (w * gy - y * gw + z * gx - x * gz)
                tz = offset[0] * on_my - offset[1] * on_mx + 0.5 * (w * gz - z * gw + x * gy - y * gx)
                to = by_views + group * 6
                store_sums(to, on_mx + hx, on_my + hy, on_mz + hz)
                store_sums(to + 3, tl.where(cut, tx, 0.0), tl.where(cut, ty, 0.0), tl.where(cut, tz, 0.0))

    if THICK:
        tl.store(by_beam + block * 3, tl.sum(zeroth, 0))
        tl.store(by_beam + block * 3 + 1, tl.sum(first, 0))
        tl.store(by_beam + block * 3 + 2, tl.sum(second, 0))
    store3(by_means, index, mask, sum_mx, sum_my, sum_mz)
    store3(by_scales, index, mask, sum_s0, sum_s1, sum_s2)
    to = by_quats + index * 4
    tl.store(to, sum_qw, mask)
    tl.store(to + 1, sum_qx, mask)
    tl.store(to + 2, sum_qy, mask)
    tl.store(to + 3, sum_qz, mask)
    logit = tl.load(transmittances + index, mask, 0.0)
    slope = tl.sigmoid(-logit) if WEIGHTED else -tl.sigmoid(logit) * tl.sigmoid(-logit)
    tl.store(by_transmittances + index, sum_absorb * slope, mask)
    term = tl.arange(0, TERMS)[None, :]
    terms: tl.constexpr = (DEGREE + 1) * (DEGREE + 1)
    owned = mask[:, None]
    tl.store(by_sh0 + index[:, None] + 0 * term, sum_sh, owned & (term == 0))
    tl.store(by_shn + index[:, None] * (terms - 1) + term - 1, sum_sh, owned & (term > 0) & (term < terms))

"""From Gaussians to slices: which of them the image plane cuts, and the 2D Gaussian each leaves (docs/physics.md §8).

One program takes BLOCK consecutive Gaussians and one pose. It culls in float32 and computes what is left in float64:
thresholds that flip are visible pixels. The slices of a block lie one after another in its own BLOCK places, in the
order of the Gaussians, so that nothing needs a global scan, a sort or a known capacity, and a frame comes out the same
every time.
"""

import triton
import triton.language as tl

from ultragray.rendering.backends.cuda.kernels.common import (
    CLIPPED_COST,
    EARLY_SIGMA_CM,
    FIELDS,
    FULL_PROFILE,
    MAX_M2,
    MAX_M2_ATTENUATION,
    MIN_PSI,
    NEGLIGIBLE,
    RECTANGLE,
    SPARE_LINES,
    SPARE_ROWS,
    VIEW,
    activate,
    harmonics,
)

# Annotations are read by Triton's compiler, so they are not postponed here.


@triton.jit
def arc_tangent(x):
    """Within 2e-8 rad (Abramowitz and Stegun, 4.4.49)."""
    steep = tl.abs(x) > 1.0
    t = tl.where(steep, 1.0 / tl.where(x == 0.0, 1.0, x), x)
    t2 = t * t
    p = 0.0028662257 * t2 - 0.0161657367
    p = p * t2 + 0.0429096138
    p = p * t2 - 0.0752896400
    p = p * t2 + 0.1065626393
    p = p * t2 - 0.1420889944
    p = p * t2 + 0.1999355085
    p = p * t2 - 0.3333314528
    p = (p * t2 + 1.0) * t
    quarter = tl.where(x < 0.0, -1.5707963267948966, 1.5707963267948966)
    return tl.where(steep, quarter - p, p)


@triton.jit
def angle_from_z(x, z):
    """Of a point, towards +x, from 0 up to a full turn."""
    steep = tl.where(z == 0.0, 1e-30, z)
    angle = arc_tangent(x / steep) + tl.where(steep < 0.0, 3.141592653589793, 0.0)
    return tl.where(angle < 0.0, angle + 6.283185307179586, angle)


@triton.jit
def load3(base, index, stride, mask):
    """Three numbers of a row."""
    at = base + index * stride
    return tl.load(at, mask, 0.0), tl.load(at + 1, mask, 0.0), tl.load(at + 2, mask, 0.0)


@triton.jit
def own_axes(w, x, y, z):
    """The columns of the rotation of a unit quaternion, one after another."""
    return (
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y + w * z),
        2.0 * (x * z - w * y),
        2.0 * (x * y - w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z + w * x),
        2.0 * (x * z + w * y),
        2.0 * (y * z - w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


@triton.jit
def along(view, axis: tl.constexpr, x, y, z):
    """The component of a scene vector along an axis of the probe: 0 lateral, 1 elevation, 2 axial."""
    a = view + 3 * axis
    return tl.load(a) * x + tl.load(a + 1) * y + tl.load(a + 2) * z


@triton.jit
def spoke(view, scale, x, y, z):
    """A Gaussian's own axis times its standard deviation, in the probe's axes."""
    return scale * along(view, 0, x, y, z), scale * along(view, 1, x, y, z), scale * along(view, 2, x, y, z)


@triton.jit
def place(view, means, scales, quats, index, mask):
    """The Gaussians of `index` as the probe sees them, in float64.

    Returns their offset from the probe's origin in the scene's axes, their mean and three spokes in the probe's, the
    unit quaternion and its norm, and the standard deviations.
    """
    mx, my, mz = load3(means, index, 3, mask)
    ox = mx.to(tl.float64) - tl.load(view + 9)
    oy = my.to(tl.float64) - tl.load(view + 10)
    oz = mz.to(tl.float64) - tl.load(view + 11)
    q = quats + index * 4
    qw = tl.load(q, mask, 1.0).to(tl.float64)
    qx = tl.load(q + 1, mask, 0.0).to(tl.float64)
    qy = tl.load(q + 2, mask, 0.0).to(tl.float64)
    qz = tl.load(q + 3, mask, 0.0).to(tl.float64)
    norm = tl.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
    qw, qx, qy, qz = qw / norm, qx / norm, qy / norm, qz / norm
    l0, l1, l2 = load3(scales, index, 3, mask)
    # Wider than e^20 cm is flat on any image, and its variance would leave float32.
    s0 = tl.exp(tl.minimum(l0.to(tl.float64), 20.0))
    s1 = tl.exp(tl.minimum(l1.to(tl.float64), 20.0))
    s2 = tl.exp(tl.minimum(l2.to(tl.float64), 20.0))
    ax, ay, az, bx, by, bz, cx, cy, cz = own_axes(qw, qx, qy, qz)
    offset = (ox, oy, oz)
    mean = (along(view, 0, ox, oy, oz), along(view, 1, ox, oy, oz), along(view, 2, ox, oy, oz))
    a, b, c = spoke(view, s0, ax, ay, az), spoke(view, s1, bx, by, bz), spoke(view, s2, cx, cy, cz)
    return offset, mean, a, b, c, (qw, qx, qy, qz), norm, (s0, s1, s2)


@triton.jit
def spread_along_elevation(view, mean, a, b, c, s, FANNED: tl.constexpr):
    """The beam's spread Σ' = Σ + variance·e eᵀ: the offset of the mean's depth from the focus, the variance there,
    eᵀΣ⁻¹e and |Σ'|/|Σ|."""
    depth = tl.sqrt(mean[0] * mean[0] + mean[2] * mean[2]) if FANNED else mean[2]
    offset = depth - tl.load(view + 18)
    variance = tl.load(view + 17) + tl.load(view + 19) * offset * offset
    along_a, along_b, along_c = a[1] / (s[0] * s[0]), b[1] / (s[1] * s[1]), c[1] / (s[2] * s[2])
    precision = along_a * along_a + along_b * along_b + along_c * along_c
    return offset, variance, precision, 1.0 + variance * precision


@triton.jit
def near_plane(view, means, scales, quats, index, mask):
    """Whether a Gaussian may come within MAX_M2 of the image plane; widened by what float32 may be off."""
    mx, my, mz = load3(means, index, 3, mask)
    nx, ny, nz = tl.load(view + 3).to(tl.float32), tl.load(view + 4).to(tl.float32), tl.load(view + 5).to(tl.float32)
    ox, oy, oz = tl.load(view + 9).to(tl.float32), tl.load(view + 10).to(tl.float32), tl.load(view + 11).to(tl.float32)
    height = nx * (mx - ox) + ny * (my - oy) + nz * (mz - oz)
    q = quats + index * 4
    w, x, y, z = tl.load(q, mask, 1.0), tl.load(q + 1, mask, 0.0), tl.load(q + 2, mask, 0.0), tl.load(q + 3, mask, 0.0)
    largest = tl.maximum(tl.maximum(tl.abs(w), tl.abs(x)), tl.maximum(tl.abs(y), tl.abs(z)))
    w, x, y, z = w / largest, x / largest, y / largest, z / largest  # the squares of tiny ones would vanish
    shrink = 1.0 / tl.sqrt(w * w + x * x + y * y + z * z)
    ax, ay, az, bx, by, bz, cx, cy, cz = own_axes(w * shrink, x * shrink, y * shrink, z * shrink)
    l0, l1, l2 = load3(scales, index, 3, mask)
    s0, s1, s2 = tl.exp(tl.minimum(l0, 20.0)), tl.exp(tl.minimum(l1, 20.0)), tl.exp(tl.minimum(l2, 20.0))
    a = s0 * (nx * ax + ny * ay + nz * az)
    b = s1 * (nx * bx + ny * by + nz * bz)
    c = s2 * (nx * cx + ny * cy + nz * cz)
    reach = 3.33 * tl.sqrt(a * a + b * b + c * c + tl.load(view + 20).to(tl.float32))
    slack = 1.0 + tl.abs(ox) + tl.abs(oy) + tl.abs(oz) + tl.abs(mx) + tl.abs(my) + tl.abs(mz) + s0 + s1 + s2
    return mask & (tl.abs(height) <= reach + 1e-6 * slack)


@triton.jit(do_not_specialize=["count", "shn_stride", "height", "width"])
def slice_gaussians(
    views,  # [C, VIEW] float64, see launch.view_table
    means,
    scales,
    quats,
    transmittances,
    sh0,
    shn,
    slices,  # [C, B, BLOCK, FIELDS] out
    rectangles,  # [C, B, BLOCK, RECTANGLE] out, int32
    bounds,  # [C, B, 4] out, int32: of all rectangles of the block
    counts,  # [C, B] out, int32
    footprints,  # [C, B] out, int64: the cost of its slices in footprint pixels
    places,  # [C, B, BLOCK] out, int32: which slice of its block a Gaussian became, -1: none; only where RECORD
    count,
    shn_stride,
    height,
    width,
    FANNED: tl.constexpr,
    WRAP: tl.constexpr,
    SIGMOID: tl.constexpr,
    DEGREE: tl.constexpr,
    THICK: tl.constexpr,
    WEIGHTED: tl.constexpr,  # m2 grows by -2 log of a Gaussian's weight, and it absorbs nothing
    RECORD: tl.constexpr,
    BLOCK: tl.constexpr,
):
    block, pose = tl.program_id(0), tl.program_id(1)
    view = views + pose * VIEW
    group = pose.to(tl.int64) * tl.num_programs(0) + block
    lanes = tl.arange(0, BLOCK)
    index = block * BLOCK + lanes
    mask = index < count
    candidate = near_plane(view, means, scales, quats, index, mask)
    has_candidate = tl.max(candidate.to(tl.int32), 0)
    if has_candidate == 0:
        tl.store(counts + group, 0)
        tl.store(footprints + group, tl.full([], 0, tl.int64))
        for side in tl.static_range(4):
            tl.store(bounds + group * 4 + side, -1)
        if RECORD:
            tl.store(places + group * BLOCK + lanes, tl.full([BLOCK], -1, tl.int32))
    else:
        offset, mean, a, b, c, _, _, s = place(view, means, scales, quats, index, candidate)
        xx = a[0] * a[0] + b[0] * b[0] + c[0] * c[0]
        xy = a[0] * a[1] + b[0] * b[1] + c[0] * c[1]
        xz = a[0] * a[2] + b[0] * b[2] + c[0] * c[2]
        yy = a[1] * a[1] + b[1] * b[1] + c[1] * c[1]
        yz = a[1] * a[2] + b[1] * b[2] + c[1] * c[2]
        zz = a[2] * a[2] + b[2] * b[2] + c[2] * c[2]
        lost = 0.0 * yy  # what m2 grows by, as the beam's weight spreads, and by a Gaussian's own weight
        if THICK:
            _, variance, _, ratio = spread_along_elevation(view, mean, a, b, c, s, FANNED)
            yy += variance
            lost = tl.log(ratio)
        logit = tl.load(transmittances + index, candidate, 0.0)
        if WEIGHTED:
            lost -= 2.0 * tl.log(tl.sigmoid(logit)).to(tl.float64)
        # Condition on the plane, y = 0.
        inverse = 1.0 / yy
        shift = -mean[1] * inverse
        m2 = mean[1] * mean[1] * inverse + lost
        x, z = mean[0] + xy * shift, mean[2] + yz * shift
        xx, xz, zz = xx - xy * xy * inverse, xz - xy * yz * inverse, zz - yz * yz * inverse
        det = xx * zz - xz * xz

        near, cull_far, row_cm = tl.load(view + 12), tl.load(view + 13), tl.load(view + 14)
        start, span = tl.load(view + 15), tl.load(view + 16)
        pitch = span / width
        if FANNED:
            depth = tl.sqrt(mean[0] * mean[0] + mean[2] * mean[2])
            inside = (depth >= near) & (depth <= cull_far)
            if WRAP:
                angle = angle_from_z(x, z)
            else:
                inside = inside & (mean[2] > 0.0)
                angle = arc_tangent(x / tl.maximum(z, 1e-30))
            line = (angle - start) / span * width - 0.5
        else:
            inside = (mean[2] >= near) & (mean[2] <= cull_far)
            line = (x - start) / span * width - 0.5
        kept = candidate & inside & (m2 <= MAX_M2) & (xx > 0.0) & (det > 0.0)

        # From here on about a scan line near the mean: t across that line, r along it. Distances stay small there, and
        # float32 keeps their digits.
        column = tl.minimum(tl.maximum(line, 0.0), width - 1.0).to(tl.int32)
        if FANNED:
            theta = start + (column.to(tl.float64) + 0.5) * pitch
            dx, dz = tl.sin(theta), tl.cos(theta)
            t, r = dz * x - dx * z, dx * x + dz * z
            tt = dz * dz * xx - 2.0 * dx * dz * xz + dx * dx * zz
            tr = dx * dz * (xx - zz) + xz * (dz * dz - dx * dx)
            rr = dx * dx * xx + 2.0 * dx * dz * xz + dz * dz * zz
            spread = tl.sqrt(tt + rr)
        else:
            t, r = x - (start + (column.to(tl.float64) + 0.5) * pitch), z
            tt, tr, rr = xx, xz, zz
            spread = tl.sqrt(rr)  # no standard deviation along a scan line is larger

        # Scan lines whose ray comes within MAX_M2.
        room = MAX_M2 - m2
        if FANNED:  # the ellipse's tangents from the apex: roots in tan(angle)
            qa, qb, qc = r * r - room * rr, t * r - room * tr, t * t - room * tt
            discriminant = qb * qb - qa * qc
            open_fan = (qa > 0.0) & (discriminant >= 0.0) & (r > 0.0)  # else it reaches the plane of the apex
            root = tl.sqrt(tl.maximum(discriminant, 0.0))
            divisor = tl.where(open_fan, qa, 1.0)
            first = tl.where(open_fan, column + arc_tangent((qb - root) / divisor) / pitch, 0.0)
            last = tl.where(open_fan, column + arc_tangent((qb + root) / divisor) / pitch, width - 1.0)
        else:
            half = tl.sqrt(tl.maximum(room * tt, 0.0))
            first, last = column + (t - half) / pitch, column + (t + half) / pitch
        if WRAP:  # columns go on over the seam: from one of the frame to at most the one before it, a turn later
            first, last = tl.floor(first), tl.ceil(last)
            every = last - first + 1.0 >= width  # of few lines, some are behind the apex
            turned = tl.where(first < 0.0, width + 0.0, 0.0)
            first_column = tl.where(every, 0.0, first + turned).to(tl.int32)
            last_column = tl.where(every, width - 1.0, last + turned).to(tl.int32)
        else:
            first_column = tl.minimum(tl.maximum(tl.floor(first), 0.0), width + 0.0).to(tl.int32)
            last_column = tl.maximum(tl.minimum(tl.ceil(last), width - 1.0), -1.0).to(tl.int32)

        # Rows: down to where the echo is nothing and the absorption complete, that row included.
        opaque = (m2 <= MAX_M2_ATTENUATION) & (tl.exp(-0.5 * m2) * spread * FULL_PROFILE >= MIN_PSI)
        if WEIGHTED:
            opaque = m2 < 0.0  # none
        early = opaque & (spread > EARLY_SIGMA_CM)
        top = r - tl.sqrt(tl.maximum(room * rr, 0.0))
        below = tl.where(opaque, NEGLIGIBLE, MAX_M2) - m2
        bottom = tl.abs(r) + tl.sqrt(tl.maximum(below * rr, 0.0))
        if FANNED:
            side = tl.abs(t) + tl.sqrt(tl.maximum(below * tt, 0.0))
            bottom = tl.sqrt(bottom * bottom + side * side)
        bottom = tl.where(opaque, tl.maximum(bottom, 3.0 * spread), bottom)  # where depth 0 clips the window
        top_row = tl.where(early, 0.0, (top - near) / row_cm - 0.5)
        end_row = (bottom - near) / row_cm - 0.5
        last_row = tl.minimum(tl.maximum(tl.ceil(end_row), tl.where(opaque, 0.0, -1.0)), height - 1.0).to(tl.int32)
        first_row = tl.minimum(tl.maximum(tl.floor(top_row), 0.0), height + 0.0).to(tl.int32)
        first_row = tl.where(opaque, tl.minimum(first_row, last_row), first_row)
        clipped = early | (top < 6.4 * spread)
        if WRAP:
            clipped = clipped | every
        kept = kept & (first_column <= last_column) & (first_row <= last_row)
        row = tl.minimum(tl.maximum((r - near) / row_cm, 0.0), height - 1.0).to(tl.int32)

        vx, vy, vz = offset[0].to(tl.float32), offset[1].to(tl.float32), offset[2].to(tl.float32)
        value = harmonics(vx, vy, vz, sh0, shn, shn_stride, index, kept, DEGREE)
        intensity = activate(value, SIGMOID)
        absorb = tl.zeros([BLOCK], tl.float32) if WEIGHTED else tl.sigmoid(-logit)

        rank = tl.cumsum(kept.to(tl.int32), 0) - 1
        slot = group * BLOCK + rank
        to = slices + slot * FIELDS
        tl.store(to, t.to(tl.float32), kept)
        tl.store(to + 1, (near + row_cm * (row.to(tl.float64) + 0.5) - r).to(tl.float32), kept)
        tl.store(to + 2, r.to(tl.float32), kept)
        tl.store(to + 3, m2.to(tl.float32), kept)
        tl.store(to + 4, tt.to(tl.float32), kept)
        tl.store(to + 5, tr.to(tl.float32), kept)
        tl.store(to + 6, rr.to(tl.float32), kept)
        tl.store(to + 7, det.to(tl.float32), kept)
        tl.store(to + 8, intensity, kept)
        tl.store(to + 9, absorb, kept)
        to = rectangles + slot * RECTANGLE
        tl.store(to, first_column, kept)
        tl.store(to + 1, last_column, kept)
        tl.store(to + 2, first_row, kept)
        tl.store(to + 3, last_row, kept)
        tl.store(to + 4, column, kept)
        tl.store(to + 5, row, kept)
        tl.store(to + 6, clipped.to(tl.int32), kept)

        tl.store(counts + group, tl.sum(kept.to(tl.int32), 0))
        rows = (last_row - first_row + 1) * tl.where(clipped, CLIPPED_COST, 1) + SPARE_ROWS
        pixels = (last_column - first_column + 1 + SPARE_LINES).to(tl.int64) * rows
        tl.store(footprints + group, tl.sum(tl.where(kept, pixels, 0), 0))
        to = bounds + group * 4
        tl.store(to, tl.min(tl.where(kept, first_column, width), 0))
        tl.store(to + 1, tl.max(tl.where(kept, last_column, -1), 0))
        tl.store(to + 2, tl.min(tl.where(kept, first_row, height), 0))
        tl.store(to + 3, tl.max(tl.where(kept, last_row, -1), 0))
        if RECORD:
            tl.store(places + group * BLOCK + lanes, tl.where(kept, rank, -1))

"""The backward pass over pixels (docs/physics.md §4, §8): from the loss's gradients on frames to those on slices.

Every slice reads its own footprint, so nothing is added to from two sides and a step gives the same numbers every time.
Thresholds and culls are held fixed; all else is the true gradient.
"""

import triton
import triton.language as tl

from ultragray.rendering.backends.cuda.kernels.common import (
    FIELDS,
    GRADIENTS,
    HALF_LOG2_E,
    LOG2_E,
    MAX_M2,
    MAX_WEIGHT,
    MIN_PSI,
    RECTANGLE,
    cross,
    peak_of,
    profile_slopes,
    shortest_turn,
)


@triton.jit(
    do_not_specialize=[
        "height",
        "width",
        "has_bmode",
        "has_echo",
        "has_transmittance",
        "has_coverage",
        "has_sum",
        "has_weighted_sum",
    ]
)
def differentiate_pixels(
    weight,  # [C, H, W] S, the sum of I·w and T, as the forward pass left them
    weighted,
    transmittance,
    by_bmode,  # [C, H, W] gradients of the loss, where given
    by_echo,
    by_transmittance,
    by_coverage,
    by_sum,
    by_weighted_sum,
    by_weight,  # [C, H, W] out: by S
    by_weighted,  # out: by the sum of I·w
    by_log,  # out: by log T
    by_below,  # out: by log of a factor of T on all rows from this one down
    height,
    width,
    has_bmode,
    has_echo,
    has_transmittance,
    has_coverage,
    has_sum,
    has_weighted_sum,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
):
    strip, pose = tl.program_id(0), tl.program_id(1).to(tl.int64)
    columns = strip * COLUMNS + tl.arange(0, COLUMNS)
    below = tl.zeros([COLUMNS], tl.float32)
    chunks = tl.cdiv(height, ROWS)
    for k in range(0, chunks):
        rows = (chunks - 1 - k) * ROWS + tl.arange(0, ROWS)
        inside = (rows < height)[:, None] & (columns < width)[None, :]
        pixel = (pose * height + rows[:, None]) * width + columns[None, :]
        total = tl.load(weight + pixel, inside, 0.0)
        sum_iw = tl.load(weighted + pixel, inside, 0.0)
        passed = tl.load(transmittance + pixel, inside, 0.0)
        on_bmode = tl.load(by_bmode + pixel, inside & (has_bmode != 0), 0.0)
        on_echo = tl.load(by_echo + pixel, inside & (has_echo != 0), 0.0) + on_bmode * passed
        on_passed = tl.load(by_transmittance + pixel, inside & (has_transmittance != 0), 0.0)
        on_coverage = tl.load(by_coverage + pixel, inside & (has_coverage != 0), 0.0)
        on_sum = tl.load(by_sum + pixel, inside & (has_sum != 0), 0.0)
        on_weighted_sum = tl.load(by_weighted_sum + pixel, inside & (has_weighted_sum != 0), 0.0)

        # E = ratio * share * sum(I w), ratio = (1 - exp(-S)) / S, share = S / (S + 1e-8).
        decay = tl.exp(-total)
        small = total <= 0.03  # differences of nearly equal numbers there
        inverse, guarded = 1.0 / tl.maximum(total, 1e-30), 1.0 / (total + 1e-8)
        ratio = tl.where(
            small,
            1.0 - total * (0.5 - total * (0.16666666666666666 - total * 0.041666666666666664)),
            (1.0 - decay) * inverse,
        )
        slope = tl.where(
            small,
            total * (0.3333333333333333 - total * (0.125 - total * 0.03333333333333333)) - 0.5,
            (decay - ratio) * inverse,
        )
        share = total * guarded
        factor = ratio * share
        factor_slope = slope * share + ratio * (1e-8 * guarded * guarded)

        on_log = (on_passed + on_bmode * factor * sum_iw) * passed
        suffix = tl.cumsum(on_log, 0, reverse=True) + below[None, :]
        below += tl.sum(on_log, 0)
        tl.store(by_weight + pixel, on_echo * sum_iw * factor_slope + on_coverage * decay + on_sum, inside)
        tl.store(by_weighted + pixel, on_echo * factor + on_weighted_sum, inside)
        tl.store(by_log + pixel, on_log, inside)
        tl.store(by_below + pixel, suffix, inside)


@triton.jit
def column_field(slices, slot, mask, number: tl.constexpr):
    """A number of each slice, [S] -> [S, 1]; 1 where there is none."""
    return tl.load(slices + slot * FIELDS + number, mask, 1.0)[:, None]


@triton.jit(do_not_specialize=["blocks", "height", "width"])
def gather_slices(
    slices,
    rectangles,
    counts,
    by_weight,  # [C, H, W], as differentiate_pixels leaves them
    by_weighted,
    by_log,
    by_below,
    gradients,  # [C, B, BLOCK, GRADIENTS] out
    blocks,
    height,
    width,
    pitch,
    row_cm,
    FANNED: tl.constexpr,
    WRAP: tl.constexpr,
    ABSORBS: tl.constexpr,
    BLOCK: tl.constexpr,
    S_LANES: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
):
    """One program takes every n-th of the slices of a block, S_LANES at a time, and of each its footprint."""
    block, share, pose = tl.program_id(0), tl.program_id(1), tl.program_id(2).to(tl.int64)
    group = pose * blocks + block
    count = tl.load(counts + group)
    for first in range(share * S_LANES, count, tl.num_programs(1) * S_LANES):
        lane = first + tl.arange(0, S_LANES)
        present = lane < count
        slot = group * BLOCK + lane
        rectangle = rectangles + slot * RECTANGLE
        first_column, last_column = tl.load(rectangle, present, 0), tl.load(rectangle + 1, present, -1)
        first_row, last_row = tl.load(rectangle + 2, present, 0), tl.load(rectangle + 3, present, -1)
        column, row = tl.load(rectangle + 4, present, 0), tl.load(rectangle + 5, present, 0)
        t, r = column_field(slices, slot, present, 0), column_field(slices, slot, present, 2)
        row_offset, m2_plane = column_field(slices, slot, present, 1), column_field(slices, slot, present, 3)
        tt, tr = column_field(slices, slot, present, 4), column_field(slices, slot, present, 5)
        rr, det = column_field(slices, slot, present, 6), column_field(slices, slot, present, 7)
        intensity, absorb = column_field(slices, slot, present, 8), column_field(slices, slot, present, 9)

        on_t = tl.zeros([S_LANES, COLUMNS], tl.float32)
        on_r = tl.zeros([S_LANES, COLUMNS], tl.float32)
        on_tt = tl.zeros([S_LANES, COLUMNS], tl.float32)
        on_tr = tl.zeros([S_LANES, COLUMNS], tl.float32)
        on_rr = tl.zeros([S_LANES, COLUMNS], tl.float32)
        on_det = tl.zeros([S_LANES, COLUMNS], tl.float32)  # by det apart: of a thin sheet it is all that matters
        on_m2 = tl.zeros([S_LANES, COLUMNS], tl.float32)
        on_intensity = tl.zeros([S_LANES, COLUMNS], tl.float32)
        on_absorb = tl.zeros([S_LANES, COLUMNS], tl.float32)
        for x in range(0, tl.max(last_column - first_column, 0) + 1, COLUMNS):
            columns = first_column[:, None] + x + tl.arange(0, COLUMNS)[None, :]  # [S, columns]
            turn = (columns - column[:, None]).to(tl.float32)
            dx, dz, across, spread, m2, sigma, past, star, touched = cross(
                shortest_turn(turn, width, WRAP), t, row_offset, r, m2_plane, tt, tr, rr, det, pitch, FANNED
            )
            touched = touched & (columns <= last_column[:, None])
            if WRAP:
                columns = tl.where(columns >= width, columns - width, columns)
            scale = 1.0 / sigma
            peak = peak_of(m2, sigma, touched) if ABSORBS else 0.0 * sigma
            zero = -star * scale
            window2 = tl.where(touched, MAX_M2 - m2, -1.0)

            sum_intensity = tl.zeros([S_LANES, ROWS, COLUMNS], tl.float32)
            sum_absorb = tl.zeros([S_LANES, ROWS, COLUMNS], tl.float32)
            sum_weight = tl.zeros([S_LANES, ROWS, COLUMNS], tl.float32)  # by each weight, times it
            sum_psi = tl.zeros([S_LANES, ROWS, COLUMNS], tl.float32)  # by each psi, times it
            sum_u = tl.zeros([S_LANES, ROWS, COLUMNS], tl.float32)
            sum_uu = tl.zeros([S_LANES, ROWS, COLUMNS], tl.float32)  # by each u, times it
            sum_zero = tl.zeros([S_LANES, ROWS, COLUMNS], tl.float32)
            for y in range(0, tl.max(last_row - first_row, 0) + 1, ROWS):
                rows = first_row[:, None] + y + tl.arange(0, ROWS)[None, :]  # [S, rows]
                down = (rows - row[:, None]).to(tl.float32)[:, :, None]
                inside = touched[:, None, :] & (rows <= last_row[:, None])[:, :, None]
                pixel = (pose * height + rows[:, :, None]) * width + columns[:, None, :]
                u = down * (row_cm * scale)[:, None, :] + (past * scale)[:, None, :]
                shape, by_u, by_zero = profile_slopes(u, zero[:, None, :] + 0.0 * u)
                psi = peak[:, None, :] * shape
                u2 = u * u
                counted = inside & ((u2 <= window2[:, None, :]) | (psi >= MIN_PSI))
                w = tl.exp2((u2 + m2[:, None, :]) * -HALF_LOG2_E)
                weight = tl.where(counted, tl.minimum(w, MAX_WEIGHT), 0.0)
                alpha = 1.0 - tl.exp2(psi * -LOG2_E)
                capped = tl.minimum(alpha, MAX_WEIGHT)

                on_weighted = tl.load(by_weighted + pixel, inside, 0.0)
                on_weight = tl.load(by_weight + pixel, inside, 0.0) + intensity[:, :, None] * on_weighted
                weighed = tl.where(w <= MAX_WEIGHT, on_weight * weight, 0.0)
                on_log = tl.load(by_log + pixel, inside, 0.0)
                on_factor = tl.where(counted, on_log / (1.0 - absorb[:, :, None] * capped), 0.0)
                on_psi = tl.where(alpha <= MAX_WEIGHT, -absorb[:, :, None] * on_factor * (1.0 - alpha), 0.0)
                on_u = tl.where(counted, on_psi * peak[:, None, :] * by_u - u * weighed, 0.0)
                sum_intensity += on_weighted * weight
                sum_absorb -= tl.where(counted, on_factor * capped, 0.0)
                sum_weight += weighed
                sum_psi += tl.where(counted, psi * on_psi, 0.0)
                sum_u += on_u
                sum_uu += tl.where(counted, on_u * u, 0.0)
                sum_zero += tl.where(counted, on_psi * peak[:, None, :] * by_zero, 0.0)
            line_absorb, line_psi = tl.sum(sum_absorb, 1), tl.sum(sum_psi, 1)  # [S, columns]
            line_u, line_uu = tl.sum(sum_u, 1), tl.sum(sum_uu, 1)
            line_zero, line_weight = tl.sum(sum_zero, 1), tl.sum(sum_weight, 1)

            # Below its last row the slice is one factor; its profile no longer depends on u there.
            beneath = touched & (last_row + 1 < height)[:, None]
            shape, _, by_zero = profile_slopes(tl.maximum(zero, 0.0) + 4.0, zero)
            psi = peak * shape
            alpha = 1.0 - tl.exp2(psi * -LOG2_E)
            capped = tl.minimum(alpha, MAX_WEIGHT)
            passes = beneath & (psi >= MIN_PSI)
            on_log = tl.load(by_below + (pose * height + last_row[:, None] + 1) * width + columns, passes, 0.0)
            on_factor = tl.where(passes, on_log / (1.0 - absorb * capped), 0.0)
            on_psi = tl.where(passes & (alpha <= MAX_WEIGHT), -absorb * on_factor * (1.0 - alpha), 0.0)
            line_absorb -= tl.where(passes, on_factor * capped, 0.0)
            line_psi += tl.where(passes, psi * on_psi, 0.0)
            line_zero += tl.where(passes, on_psi * peak * by_zero, 0.0)

            # u = (s - s*) / sigma, zero = -s* / sigma, psi = exp(-m2 / 2) sigma G(u, zero).
            by_star = -(line_u + line_zero) * scale
            by_variance = 0.5 * (line_psi - line_uu - tl.where(touched, line_zero * zero, 0.0)) * scale * scale
            by_m2 = -0.5 * (line_weight + line_psi)
            # With a the line's normal and e its direction: m2 = across2 / q, s* = e.mean - k across / q and
            # variance = det / q, where q = a.C a, k = a.C e and det = det C.
            k = dx * dz * (rr - tt) + tr * (dx * dx - dz * dz)
            slant = across * spread
            by_k = -by_star * slant
            by_across = 2.0 * by_m2 * slant - by_star * k * spread
            by_q = (by_star * k * slant - by_variance * sigma * sigma) * spread - by_m2 * slant * slant
            on_t += tl.where(touched, dx * by_star - dz * by_across, 0.0)
            on_r += tl.where(touched, dz * by_star + dx * by_across, 0.0)
            on_tt += tl.where(touched, by_q * dz * dz - by_k * dx * dz, 0.0)
            on_tr += tl.where(touched, by_k * (dx * dx - dz * dz) - 2.0 * by_q * dx * dz, 0.0)
            on_rr += tl.where(touched, by_q * dx * dx + by_k * dx * dz, 0.0)
            on_det += tl.where(touched, by_variance * spread, 0.0)
            on_m2 += tl.where(touched, by_m2, 0.0)
            on_intensity += tl.sum(sum_intensity, 1)
            on_absorb += line_absorb
        to = gradients + slot * GRADIENTS
        tl.store(to, tl.sum(on_t, 1), present)
        tl.store(to + 1, tl.sum(on_r, 1), present)
        tl.store(to + 2, tl.sum(on_tt, 1), present)
        tl.store(to + 3, tl.sum(on_tr, 1), present)
        tl.store(to + 4, tl.sum(on_rr, 1), present)
        tl.store(to + 5, tl.sum(on_m2, 1), present)
        tl.store(to + 6, tl.sum(on_intensity, 1), present)
        tl.store(to + 7, tl.sum(on_absorb, 1), present)
        tl.store(to + 8, tl.sum(on_det, 1), present)

"""From slices to pixels (docs/physics.md §3, §8): S, the sum of I·w and T, then the outputs.

One program draws one tile of one pose: it finds the blocks whose bounds touch the tile, and of those the slices,
S_LANES at a time. Below its last row a slice is one constant factor of T on each scan line; the tile that holds that
row hands the factor to the tiles beneath.
"""

import triton
import triton.language as tl

from ultragray.rendering.backends.cuda.kernels.common import (
    FIELDS,
    HALF_LOG2_E,
    LOG2_E,
    MAX_M2,
    MAX_WEIGHT,
    MIN_PSI,
    NOTHING,
    RECTANGLE,
    clipped_profile,
    cross,
    peak_of,
    polynomial_profile,
    shortest_turn,
)


@triton.jit
def touches(rectangle, mask, x0, x1, y0, y1, width, WRAP: tl.constexpr):
    """Whether rectangles (first and last column, first and last row) have pixels in common with one."""
    last = tl.load(rectangle + 1, mask, -1)
    across = (tl.load(rectangle, mask, NOTHING) <= x1) & (last >= x0)
    if WRAP:
        across = across | (last - width >= x0)
    return across & (tl.load(rectangle + 2, mask, NOTHING) <= y1) & (tl.load(rectangle + 3, mask, -1) >= y0)


@triton.jit
def field(slices, slot, mask, number: tl.constexpr):
    """A number of each slice, [S] -> [S, 1, 1]; 1 where there is none."""
    return tl.load(slices + slot * FIELDS + number, mask, 1.0)[:, None, None]


@triton.jit(do_not_specialize=["blocks", "height", "width"])
def draw_tiles(
    slices,
    rectangles,
    bounds,
    counts,
    weight,  # [C, H, W] out: S
    weighted,  # [C, H, W] out: the sum of I·w
    local,  # [C, H, W] out: T of this tile alone
    steps,  # [C, tile rows, W] out: the factor of T that a tile hands to those beneath
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
    TILE_ROWS: tl.constexpr,
    TILE_COLUMNS: tl.constexpr,
    CHUNK: tl.constexpr,
):
    tile_x, tile_y, pose = tl.program_id(0), tl.program_id(1), tl.program_id(2).to(tl.int64)
    x0, y0 = tile_x * TILE_COLUMNS, tile_y * TILE_ROWS
    x1, y1 = tl.minimum(x0 + TILE_COLUMNS, width) - 1, tl.minimum(y0 + TILE_ROWS, height) - 1
    columns = x0 + tl.arange(0, TILE_COLUMNS)
    rows = y0 + tl.arange(0, TILE_ROWS)
    columns_at = columns.to(tl.float32)[None, None, :]
    rows_at = rows.to(tl.float32)[None, :, None]

    total = tl.zeros([TILE_ROWS, TILE_COLUMNS], tl.float32)
    echo = tl.zeros([TILE_ROWS, TILE_COLUMNS], tl.float32)
    passing = tl.full([TILE_ROWS, TILE_COLUMNS], 1.0, tl.float32)  # T of slices that go on beneath the tile
    ending = tl.full([TILE_ROWS, TILE_COLUMNS], 1.0, tl.float32)  # T of those that end in it
    for start in range(0, blocks, CHUNK):
        block = start + tl.arange(0, CHUNK)
        known = block < blocks
        hit = touches(bounds + (pose * blocks + block) * 4, known, x0, x1, y0, y1, width, WRAP)
        chosen = tl.min(tl.where(hit, block, NOTHING), 0)
        while chosen < NOTHING:
            group = pose * blocks + chosen
            count = tl.load(counts + group)
            if S_LANES == 1:  # a warp picks those that touch the tile out of the whole block at once
                lane = tl.arange(0, BLOCK)
                hits = touches(
                    rectangles + (group * BLOCK + lane) * RECTANGLE, lane < count, x0, x1, y0, y1, width, WRAP
                )
                picked = tl.min(tl.where(hits, lane, NOTHING), 0)
                while picked < NOTHING:
                    total, echo, passing, ending = add_slices(
                        total,
                        echo,
                        passing,
                        ending,
                        slices,
                        rectangles,
                        group * BLOCK + picked + tl.arange(0, 1),
                        tl.full([1], 1, tl.int1),
                        columns_at,
                        rows_at,
                        y1,
                        pitch,
                        row_cm,
                        width,
                        FANNED,
                        WRAP,
                        ABSORBS,
                        S_LANES,
                    )
                    picked = tl.min(tl.where(hits & (lane > picked), lane, NOTHING), 0)
            else:
                for first in range(0, count, S_LANES):
                    lane = first + tl.arange(0, S_LANES)
                    slot = group * BLOCK + lane
                    hits = touches(rectangles + slot * RECTANGLE, lane < count, x0, x1, y0, y1, width, WRAP)
                    total, echo, passing, ending = add_slices(
                        total,
                        echo,
                        passing,
                        ending,
                        slices,
                        rectangles,
                        slot,
                        hits,
                        columns_at,
                        rows_at,
                        y1,
                        pitch,
                        row_cm,
                        width,
                        FANNED,
                        WRAP,
                        ABSORBS,
                        S_LANES,
                    )
            chosen = tl.min(tl.where(hit & (block > chosen), block, NOTHING), 0)

    inside = (rows < height)[:, None] & (columns < width)[None, :]
    pixel = (pose * height + rows[:, None]) * width + columns[None, :]
    tl.store(weight + pixel, total, inside)
    tl.store(weighted + pixel, echo, inside)
    tl.store(local + pixel, passing * ending, inside)
    bottom = tl.sum(tl.where((rows == y0 + TILE_ROWS - 1)[:, None], ending, 0.0), 0)
    tl.store(steps + (pose * tl.num_programs(1) + tile_y) * width + columns, bottom, columns < width)


@triton.jit
def add_slices(
    total,
    echo,
    passing,
    ending,
    slices,
    rectangles,
    slot,  # [S]
    hits,  # [S] which of them there are
    columns_at,  # [1, 1, columns]
    rows_at,  # [1, rows, 1]
    y1,
    pitch,
    row_cm,
    width,
    FANNED: tl.constexpr,
    WRAP: tl.constexpr,
    ABSORBS: tl.constexpr,
    S_LANES: tl.constexpr,
):
    """The accumulators of a tile, with some slices added."""
    rectangle = rectangles + slot * RECTANGLE
    turn = columns_at - tl.load(rectangle + 4, hits, 0).to(tl.float32)[:, None, None]  # [S, 1, columns]
    down = rows_at - tl.load(rectangle + 5, hits, 0).to(tl.float32)[:, None, None]  # [S, rows, 1]
    _, _, _, _, m2, sigma, past, star, touched = cross(
        shortest_turn(turn, width, WRAP),
        field(slices, slot, hits, 0),
        field(slices, slot, hits, 1),
        field(slices, slot, hits, 2),
        field(slices, slot, hits, 3),
        field(slices, slot, hits, 4),
        field(slices, slot, hits, 5),
        field(slices, slot, hits, 6),
        field(slices, slot, hits, 7),
        pitch,
        FANNED,
    )
    touched = touched & hits[:, None, None]
    if FANNED:  # a line of the far side of a wide fan meets the slice behind the apex
        last = tl.load(rectangle + 1, hits, -1)[:, None, None]
        own = (tl.load(rectangle, hits, 0)[:, None, None] <= columns_at) & (columns_at <= last)
        if WRAP:
            own = own | (columns_at + width <= last)
        touched = touched & own
    scale = 1.0 / sigma
    peak = peak_of(m2, sigma, touched) * -LOG2_E if ABSORBS else 0.0 * sigma
    echo_peak = m2 * -HALF_LOG2_E
    window2 = tl.where(touched, MAX_M2 - m2, -1.0)  # u2 up to here has w >= 1/255
    u = down * (row_cm * scale) + past * scale  # [S, rows, columns]
    if tl.max(tl.load(rectangle + 6, hits, 0), 0) > 0:
        shape = clipped_profile(u, -star * scale)
    else:
        shape = polynomial_profile(u)
    fall = peak * shape  # -psi, to base 2
    u2 = u * u
    counted = (u2 <= window2) | (fall <= -LOG2_E * MIN_PSI)
    w = tl.minimum(tl.exp2(u2 * -HALF_LOG2_E + echo_peak), MAX_WEIGHT)
    w = tl.where(counted, w, 0.0)
    transparency = tl.where(counted, tl.maximum(tl.exp2(fall), 1.0 - MAX_WEIGHT), 1.0)  # 1 - alpha
    absorb = tl.load(slices + slot * FIELDS + 9, hits, 0.0)
    ends = tl.load(rectangle + 3, hits, 0) <= y1
    return (
        total + tl.sum(w, 0),
        echo + tl.sum(field(slices, slot, hits, 8) * w, 0),
        passing * product(passed(transparency, tl.where(ends, 0.0, absorb)), S_LANES),
        ending * product(passed(transparency, tl.where(ends, absorb, 0.0)), S_LANES),
    )


@triton.jit
def passed(transparency, absorb):
    """1 - alpha (1 - tau), [S, rows, columns]; exactly 1 where nothing is absorbed."""
    return (1.0 - absorb)[:, None, None] + absorb[:, None, None] * transparency


@triton.jit
def product(factors, LANES: tl.constexpr):
    """[S, rows, columns] -> [rows, columns]; all factors are positive."""
    if LANES == 1:
        return tl.sum(factors, 0)
    else:
        return tl.exp2(tl.sum(tl.log2(factors), 0))


@triton.jit(
    do_not_specialize=["height", "width", "keep", "wants_bmode", "wants_echo", "wants_transmittance", "wants_coverage"]
)
def finish_frames(
    weight,
    weighted,
    local,  # in: T of a tile alone; out, where `keep`: T
    steps,
    bmode,  # [C, H, W] out, where wanted, as are the others
    echo,
    transmittance,
    coverage,
    height,
    width,
    keep,
    wants_bmode,
    wants_echo,
    wants_transmittance,
    wants_coverage,
    TILE_ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
):
    """B = E T, E = (1 - exp(-S)) sum(I w) / (S + 1e-8), and T with the factors of the tiles above."""
    strip, tile_y, pose = tl.program_id(0), tl.program_id(1), tl.program_id(2).to(tl.int64)
    columns = strip * COLUMNS + tl.arange(0, COLUMNS)
    rows = tile_y * TILE_ROWS + tl.arange(0, TILE_ROWS)
    across = columns < width
    handed = tl.full([COLUMNS], 1.0, tl.float32)
    for above in range(0, tile_y):
        handed *= tl.load(steps + (pose * tl.num_programs(1) + above) * width + columns, across, 1.0)
    inside = (rows < height)[:, None] & across[None, :]
    pixel = (pose * height + rows[:, None]) * width + columns[None, :]
    total = tl.load(weight + pixel, inside, 0.0)
    passed = tl.load(local + pixel, inside, 1.0) * handed[None, :]
    # 1 - exp loses digits where S is small
    share = tl.where(total <= 1e-3, total * (1.0 - 0.5 * total), 1.0 - tl.exp(-total))
    value = share * tl.load(weighted + pixel, inside, 0.0) / (total + 1e-8)
    tl.store(bmode + pixel, value * passed, inside & (wants_bmode != 0))
    tl.store(echo + pixel, value, inside & (wants_echo != 0))
    tl.store(transmittance + pixel, passed, inside & (wants_transmittance != 0))
    tl.store(coverage + pixel, share, inside & (wants_coverage != 0))
    tl.store(local + pixel, passed, inside & (keep != 0))

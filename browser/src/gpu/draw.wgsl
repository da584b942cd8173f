// From slices to sums: S, the sum of I w and T of each pixel. A workgroup draws one tile, each of its threads four rows of a
// scan line: together they find the blocks whose bounds touch the tile, and of each the slices that do. Below its last row a
// slice is one factor of T on each scan line; the tile that holds that row hands the factor to the tiles beneath.

const THREADS = 64u;
const ROWS = 4; // of a thread
const NODE = 0.7745966692414834; // Gauss-Legendre: nodes 0, +-sqrt(0.6)
const MIN_VARIANCE = 1e-32; // thinner slices touch no row

@group(0) @binding(1) var<storage, read> slices: array<Slice>;
@group(0) @binding(2) var<storage, read> extents: array<Extent>;
@group(0) @binding(3) var<storage, read> bounds: array<Bounds>;
@group(0) @binding(4) var<storage, read> angles: array<vec2f>; // [2, W]: last sine, and 1 - cosine, of so many times the pitch
@group(0) @binding(5) var<storage, read_write> sums: array<f32>; // [3, H, W]: S, the sum of I w, T of this tile alone
@group(0) @binding(6) var<storage, read_write> steps: array<f32>; // [tile rows, W]: the factor of T for the tiles beneath

alias Bits = array<atomic<u32>, 4>; // for 128 blocks, or slices: whether they touch the tile
var<workgroup> block_bits: Bits;
var<workgroup> touching: vec4u;
// Slices of the block that is drawn, of the next one, and of the one before, which others may still be drawing: so one
// barrier for each block suffices.
var<workgroup> slice_bits: array<Bits, 3>;

struct Pixels { // four rows of a scan line
    weight: vec4f, // S
    echo: vec4f, // the sum of I w
    passing: vec4f, // T of the slices that go on beneath the tile
    ending: vec4f, // T of those that end in it
}

@compute @workgroup_size(THREADS)
fn main(@builtin(workgroup_id) tile: vec3u, @builtin(local_invocation_index) lane: u32) {
    let left = i32(tile.x) * TILE;
    let upper = i32(tile.y) * TILE;
    let column = left + i32(lane) % TILE;
    let row = upper + i32(lane) / TILE * ROWS;
    var pixels = Pixels(vec4f(), vec4f(), vec4f(1.0), vec4f(1.0));
    let blocks = (view.count + BLOCK - 1) / BLOCK;
    if (lane < 12) { atomicStore(&slice_bits[lane / 4][lane % 4], 0u); }
    var turn = 0u;
    for (var start = 0u; start < blocks; start += BLOCK) {
        if (lane < 4) { atomicStore(&block_bits[lane], 0u); }
        workgroupBarrier();
        for (var k = lane; k < min(BLOCK, blocks - start); k += THREADS) {
            let b = bounds[start + k];
            if (touches(b.first, b.last, b.top, b.bottom, left, upper)) { atomicOr(&block_bits[k / 32], 1u << (k % 32)); }
        }
        workgroupBarrier();
        if (lane < 4) { touching[lane] = atomicLoad(&block_bits[lane]); }
        let chosen = workgroupUniformLoad(&touching);
        for (var word = 0u; word < 4; word++) {
            for (var bits = chosen[word]; bits != 0; bits &= bits - 1) {
                let block = start + 32 * word + countTrailingZeros(bits);
                for (var k = lane; k < bounds[block].count; k += THREADS) {
                    let e = extents[block * BLOCK + k];
                    if (touches(e.first, e.last, e.top, e.bottom, left, upper)) { atomicOr(&slice_bits[turn][k / 32], 1u << (k % 32)); }
                }
                workgroupBarrier();
                if (lane < 4) { atomicStore(&slice_bits[(turn + 2) % 3][lane], 0u); }
                for (var quarter = 0u; quarter < 4; quarter++) {
                    for (var found = atomicLoad(&slice_bits[turn][quarter]); found != 0; found &= found - 1) {
                        add(&pixels, block * BLOCK + 32 * quarter + countTrailingZeros(found), column, row, upper + TILE - 1);
                    }
                }
                turn = (turn + 1) % 3;
            }
        }
    }
    if (column >= view.width) { return; }
    let plane = view.height * view.width;
    for (var k = 0; k < ROWS && row + k < view.height; k++) {
        let pixel = (row + k) * view.width + column;
        sums[pixel] = pixels.weight[k];
        sums[plane + pixel] = pixels.echo[k];
        sums[2 * plane + pixel] = pixels.passing[k] * pixels.ending[k];
    }
    if (row + ROWS == upper + TILE) { steps[i32(tile.y) * view.width + column] = pixels.ending[ROWS - 1]; }
}

fn touches(first: i32, last: i32, top: i32, bottom: i32, left: i32, upper: i32) -> bool {
    let right = min(left + TILE, view.width) - 1;
    let across = (first <= right && last >= left) || (WRAP && last - view.width >= left);
    return across && top < upper + TILE && bottom >= upper;
}

// Adds a slice to the pixels of a scan line.
fn add(pixels: ptr<function, Pixels>, slot: u32, column: i32, row: i32, tile_bottom: i32) {
    let extent = extents[slot];
    let own = (extent.first <= column && column <= extent.last) || (WRAP && column + view.width <= extent.last);
    if (!own || row + ROWS <= extent.top) { return; }
    let slice = slices[slot];
    var turn = column - extent.line;
    if (WRAP) { turn -= view.width * i32(floor(f32(turn) / f32(view.width) + 0.5)); }

    // How the line crosses the slice: m2, sigma along the line, and s*, from which its own row lies `past`.
    var across = f32(turn) * view.pitch - slice.t;
    var variance_across = slice.tt;
    var tilt = -slice.tr;
    var lag = 0.0; // the mean lies at r - lag along the line
    if (FANNED) {
        let table = angles[view.width + min(abs(turn), view.width - 1)];
        let dx = table.x * f32(sign(turn));
        let dz = 1.0 - table.y;
        across = dx * slice.r - dz * slice.t;
        variance_across = dx * dx * slice.rr - 2.0 * dx * dz * slice.tr + dz * dz * slice.tt;
        tilt = dx * dz * (slice.rr - slice.tt) + slice.tr * (dx * dx - dz * dz);
        lag = table.y * slice.r - dx * slice.t;
    }
    let inverse = 1.0 / variance_across;
    let shift = tilt * across * inverse;
    let m2 = slice.m2 + across * across * inverse;
    let variance = slice.det * inverse;
    if (!(m2 <= MAX_M2 && variance >= MIN_VARIANCE)) { return; }
    let sigma = sqrt(variance);
    let down = vec4f(vec4i(0, 1, 2, 3) + (row - extent.row));
    let u = (down * view.row + (slice.past + lag + shift)) / sigma;

    // psi = peak G(u), here of base 2 and negative.
    let peak = select(0.0, -LOG2_E * exp2(m2 * -HALF_LOG2_E) * sigma, m2 <= MAX_M2_ATTENUATION);
    var fall: vec4f;
    if (extent.clipped != 0) {
        fall = peak * clipped_profile(u, (lag + shift - slice.r) / sigma);
    } else {
        fall = peak * profile(u);
    }
    let counted = (u * u <= vec4f(MAX_M2 - m2)) | (fall <= vec4f(-LOG2_E * MIN_PSI));
    let w = select(vec4f(), min(exp2((u * u + m2) * -HALF_LOG2_E), vec4f(MAX_WEIGHT)), counted);
    let left = select(vec4f(1.0), max(exp2(fall), vec4f(1.0 - MAX_WEIGHT)), counted); // 1 - alpha
    let passed = (1.0 - slice.absorb) + slice.absorb * left;
    (*pixels).weight += w;
    (*pixels).echo += slice.intensity * w;
    if (extent.bottom <= tile_bottom) {
        (*pixels).ending *= passed;
    } else {
        (*pixels).passing *= passed;
    }
}

// G(u) of docs/physics.md §3 where depth 0 does not clip its window, within 3.2e-4, and exact from u = 3 on, where it is
// constant: whether a crossed Gaussian counts decides over the rest of its scan line.
fn profile(u: vec4f) -> vec4f {
    let v = (clamp(u, vec4f(-3.34), vec4f(3.0)) + 0.17) * 0.31545741324921134;
    var p = -1.17912165 * v - 1.08363338;
    p = p * v + 4.49129112;
    p = p * v + 4.48426945;
    p = p * v - 6.86307471;
    p = p * v - 8.09939924;
    p = p * v + 5.18377769;
    p = p * v + 8.18838;
    p = p * v - 2.00312422;
    p = p * v - 5.11385445;
    p = p * v + 0.737662447;
    p = p * v + 3.06877651;
    return select(p * v + 1.0784183, vec4f(FULL_PROFILE), u >= vec4f(3.0));
}

fn bell(x: vec4f) -> vec4f {
    return exp2(x * x * -HALF_LOG2_E);
}

// G where depth 0, at u = zero, clips the window (or not): the three-point Gauss-Legendre rule itself.
fn clipped_profile(u: vec4f, zero: f32) -> vec4f {
    let centre = min(vec4f(max(zero, 0.0)), u);
    let low = max(centre - 3.0, vec4f(zero));
    let high = min(centre + 3.0, u);
    let half = 0.5 * (high - low);
    let middle = 0.5 * (high + low);
    let total = 0.8888888888888888 * bell(middle) + 0.5555555555555556 * (bell(middle - NODE * half) + bell(middle + NODE * half));
    let depth = u - zero;
    return select(half * total, depth * bell(0.5 * (u + zero)), (depth * depth <= vec4f(1e-8)) | (high <= low));
}

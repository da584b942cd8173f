// From Gaussians to slices: which of them the image plane cuts, and the 2D Gaussian each leaves there. The slices of a block
// lie one after another in the order of the Gaussians, so that nothing has to be sorted or to fit a capacity, and a frame
// comes out the same every time.

override THICK: bool; // the slice has a thickness
override SIGMOID: bool; // activation of intensities
override DEGREE: u32; // of the harmonics

const NEGLIGIBLE = 24.0; // w < 7e-6 beyond m2 + u2: dozens of such tails on a pixel still do not show
const EARLY_SIGMA = 1.8; // an opaque Gaussian wider than this absorbs 1/255 above the rows where w does
const WIDEST = 4.8e8; // flat on any image, and its variance is still a float32

@group(0) @binding(1) var<storage, read> gaussians: array<vec4f>; // [N, 3], see ultragray_gaussians
@group(0) @binding(2) var<storage, read> harmonics: array<f32>; // [N, K]
@group(0) @binding(3) var<storage, read> angles: array<vec2f>; // [2, W]: first sine and cosine of each scan line's angle
@group(0) @binding(4) var<storage, read_write> slices: array<Slice>;
@group(0) @binding(5) var<storage, read_write> extents: array<Extent>;
@group(0) @binding(6) var<storage, read_write> bounds: array<Bounds>;

var<workgroup> kept: array<atomic<u32>, 4>; // a bit for each Gaussian of the block
var<workgroup> first: atomic<i32>;
var<workgroup> last: atomic<i32>;
var<workgroup> top: atomic<i32>;
var<workgroup> bottom: atomic<i32>;

@compute @workgroup_size(BLOCK)
fn main(@builtin(workgroup_id) block: vec3u, @builtin(local_invocation_index) lane: u32) {
    if (lane < 4) { atomicStore(&kept[lane], 0u); }
    if (lane == 0) {
        atomicStore(&first, view.width);
        atomicStore(&last, -1);
        atomicStore(&top, view.height);
        atomicStore(&bottom, -1);
    }
    workgroupBarrier();
    let index = block.x * BLOCK + lane;
    var slice: Slice;
    var extent: Extent;
    let is_cut = index < view.count && near_plane(index) && cut(index, &slice, &extent);
    if (is_cut) {
        atomicOr(&kept[lane / 32], 1u << (lane % 32));
        atomicMin(&first, extent.first);
        atomicMax(&last, extent.last);
        atomicMin(&top, extent.top);
        atomicMax(&bottom, extent.bottom);
    }
    workgroupBarrier();
    var rank = countOneBits(atomicLoad(&kept[lane / 32]) & ((1u << (lane % 32)) - 1));
    for (var word = 0u; word < lane / 32; word++) { rank += countOneBits(atomicLoad(&kept[word])); }
    if (is_cut) {
        slices[block.x * BLOCK + rank] = slice;
        extents[block.x * BLOCK + rank] = extent;
    }
    if (lane == BLOCK - 1) {
        let count = rank + u32(is_cut);
        bounds[block.x] = Bounds(atomicLoad(&first), atomicLoad(&last), atomicLoad(&top), atomicLoad(&bottom), count);
    }
}

// Whether a Gaussian may come within MAX_M2 of the image plane; widened by what float32 may be off.
fn near_plane(index: u32) -> bool {
    let mean = gaussians[3 * index].xyz;
    let reach = gaussians[3 * index + 2].w;
    let distance = dot(view.elevation, mean - view.origin);
    let size = abs(view.origin) + abs(mean);
    return abs(distance) <= sqrt(reach * reach + MAX_M2 * view.beam.w) * 1.00001 + 1e-6 * (1.0 + size.x + size.y + size.z);
}

// The columns of the rotation of a unit quaternion w, x, y, z.
fn own_axes(q: vec4f) -> mat3x3f {
    let w = q.x; let x = q.y; let y = q.z; let z = q.w;
    return mat3x3f(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
        2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
        2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y),
    );
}

fn cut(index: u32, slice: ptr<function, Slice>, extent: ptr<function, Extent>) -> bool {
    let head = gaussians[3 * index];
    let middle = gaussians[3 * index + 1];
    let tail = gaussians[3 * index + 2];
    let scale = min(vec3f(head.w, middle.xy), vec3f(WIDEST));
    let axes = own_axes(vec4f(middle.zw, tail.xy));
    let offset = (head.xyz - view.origin) - view.origin_rest;
    let mean = vec3f(dot(view.lateral, offset), dot(view.elevation, offset), dot(view.axial, offset));
    let from_origin = length(mean.xz);
    let depth = select(mean.z, from_origin, FANNED);

    // Standard deviations along the Gaussian's own axes, seen along those of the probe: covariances are products of these
    // vectors. The beam spreads the Gaussian along elevation, as by a fourth axis of its own.
    let facing = view.elevation * axes;
    let x = vec4f(view.lateral * axes * scale, 0.0);
    var y = vec4f(facing * scale, 0.0);
    let z = vec4f(view.axial * axes * scale, 0.0);
    var ratio = 1.0; // by which that makes its volume larger
    if (THICK) {
        let from_focus = depth - view.beam.y;
        let variance = view.beam.x + view.beam.z * from_focus * from_focus;
        y.w = sqrt(variance);
        ratio += variance * dot(facing / scale, facing / scale);
    }
    let yy = dot(y, y);
    let m2 = mean.y * mean.y / yy + select(0.0, log(ratio), THICK);
    let across_plane = x - y * (dot(x, y) / yy); // given elevation 0
    let along_plane = z - y * (dot(z, y) / yy);
    let mean_x = mean.x - dot(x, y) / yy * mean.y;
    let mean_z = mean.z - dot(z, y) / yy * mean.y;
    let thickness = scale.x * scale.y * scale.z * view.volume * inverseSqrt(yy);
    let det = thickness * thickness * ratio;
    let inside = depth >= view.near && depth <= view.most && (!FANNED || WRAP || mean.z > 0.0);
    if (!(inside && m2 <= MAX_M2 && det > 0.0 && dot(across_plane, across_plane) > 0.0)) { return false; }

    // From here on about a scan line near the mean, where distances are small.
    let width = f32(view.width);
    var at = mean_x;
    if (FANNED) { at = angle_from_axis(mean_x, mean_z); }
    let line = i32(clamp((at - view.start) / view.pitch - 0.5, 0.0, width - 1.0));
    var t = mean_x - (view.start + (f32(line) + 0.5) * view.pitch);
    var r = mean_z;
    var across = across_plane;
    var along = along_plane;
    if (FANNED) {
        let direction = angles[line];
        t = direction.y * mean_x - direction.x * mean_z;
        r = direction.x * mean_x + direction.y * mean_z;
        across = direction.y * across_plane - direction.x * along_plane;
        along = direction.x * across_plane + direction.y * along_plane;
    }
    let tt = dot(across, across);
    let tr = dot(across, along);
    let rr = dot(along, along);
    let spread = sqrt(select(rr, tt + rr, FANNED)); // no standard deviation along a scan line is larger

    // Scan lines that come within MAX_M2.
    let room = MAX_M2 - m2;
    var low = f32(line) + (t - sqrt(room * tt)) / view.pitch;
    var high = f32(line) + (t + sqrt(room * tt)) / view.pitch;
    if (FANNED) { // the ellipse's tangents from the origin: roots in tan(angle)
        let a = r * r - room * rr;
        let b = t * r - room * tr;
        let discriminant = b * b - a * (t * t - room * tt);
        low = 0.0;
        high = width - 1.0;
        if (a > 0.0 && discriminant >= 0.0 && r > 0.0) { // else it reaches behind the origin
            low = f32(line) + arc_tangent((b - sqrt(discriminant)) / a) / view.pitch;
            high = f32(line) + arc_tangent((b + sqrt(discriminant)) / a) / view.pitch;
        }
    }
    low = floor(low);
    high = ceil(high);
    var every = false; // of few lines all the way round, some are behind the origin
    if (WRAP) {
        every = high - low + 1.0 >= width;
        let turned = select(0.0, width, low < 0.0);
        low = select(low + turned, 0.0, every);
        high = select(high + turned, width - 1.0, every);
    } else {
        low = clamp(low, 0.0, width);
        high = clamp(high, -1.0, width - 1.0);
    }

    // Rows: down to where the echo is nothing and the absorption complete, that row included.
    let opaque = m2 <= MAX_M2_ATTENUATION && exp(-0.5 * m2) * spread * FULL_PROFILE >= MIN_PSI;
    let early = opaque && spread > EARLY_SIGMA;
    let nearest = r - sqrt(room * rr);
    let below = select(MAX_M2, NEGLIGIBLE, opaque) - m2;
    var farthest = r + sqrt(below * rr);
    if (FANNED) { farthest = length(vec2f(abs(r) + sqrt(below * rr), abs(t) + sqrt(below * tt))); }
    if (opaque) { farthest = max(farthest, 3.0 * spread); } // where depth 0 clips the window
    let height = f32(view.height);
    let end = clamp(ceil((farthest - view.near) / view.row - 0.5), select(-1.0, 0.0, opaque), height - 1.0);
    var begin = select(clamp(floor((nearest - view.near) / view.row - 0.5), 0.0, height), 0.0, early);
    if (opaque) { begin = min(begin, end); }
    if (low > high || begin > end) { return false; }

    let row = i32(clamp((r - view.near) / view.row, 0.0, height - 1.0));
    let past = view.near + view.row * (f32(row) + 0.5) - r;
    *slice = Slice(t, past, r, m2, tt, tr, rr, det, intensity(index, offset), tail.z);
    *extent = Extent(i32(low), i32(high), i32(begin), i32(end), line, row, u32(early || every || nearest < 6.4 * spread));
    return true;
}

// Within 2e-8 rad (Abramowitz and Stegun, 4.4.49); that of the language may be off by 5e-4.
fn arc_tangent(x: f32) -> f32 {
    let steep = abs(x) > 1.0;
    let t = select(x, 1.0 / x, steep);
    let t2 = t * t;
    var p = 0.0028662257 * t2 - 0.0161657367;
    p = p * t2 + 0.0429096138;
    p = p * t2 - 0.0752896400;
    p = p * t2 + 0.1065626393;
    p = p * t2 - 0.1420889944;
    p = p * t2 + 0.1999355085;
    p = p * t2 - 0.3333314528;
    p = (p * t2 + 1.0) * t;
    return select(p, sign(x) * 1.5707963267948966 - p, steep);
}

// Of a point, towards the lateral axis: all the way round from 0 up to a full turn, else within a quarter of one.
fn angle_from_axis(x: f32, z: f32) -> f32 {
    if (!WRAP) { return arc_tangent(x / max(z, 1e-30)); }
    let steep = select(z, 1e-30, z == 0.0);
    let angle = arc_tangent(x / steep) + select(0.0, 3.141592653589793, steep < 0.0);
    return angle + select(0.0, 6.283185307179586, angle < 0.0);
}

// The echo of a Gaussian seen along an offset from the probe (docs/physics.md §2).
fn intensity(index: u32, offset: vec3f) -> f32 {
    let at = index * (DEGREE + 1) * (DEGREE + 1);
    let v = offset * inverseSqrt(max(dot(offset, offset), 1e-36));
    let x = v.x; let y = v.y; let z = v.z;
    var value = 0.28209479177387814 * harmonics[at];
    if (DEGREE >= 1) { value += 0.4886025119029199 * (z * harmonics[at + 2] - y * harmonics[at + 1] - x * harmonics[at + 3]); }
    if (DEGREE >= 2) {
        value += 1.0925484305920792 * (x * y * harmonics[at + 4] - y * z * harmonics[at + 5] - x * z * harmonics[at + 7]);
        value += 0.31539156525252005 * (2.0 * z * z - x * x - y * y) * harmonics[at + 6];
        value += 0.5462742152960396 * (x * x - y * y) * harmonics[at + 8];
    }
    if (DEGREE >= 3) {
        value -= 0.5900435899266435 * (y * (3.0 * x * x - y * y) * harmonics[at + 9] + x * (x * x - 3.0 * y * y) * harmonics[at + 15]);
        value += 2.890611442640554 * x * y * z * harmonics[at + 10];
        value -= 0.4570457994644658 * (4.0 * z * z - x * x - y * y) * (y * harmonics[at + 11] + x * harmonics[at + 13]);
        value += 0.3731763325901154 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y) * harmonics[at + 12];
        value += 1.445305721320277 * z * (x * x - y * y) * harmonics[at + 14];
    }
    return select(clamp(value + 1.0, 0.5, 0.999), 1.0 / (1.0 + exp(-4.0 * value)), SIGMOID);
}

// What the passes share: the pose's view, and what they hand on. Lengths are cm (docs/physics.md §3, §8); the plan is that of
// the CUDA backend, but all is float32. Where that one takes float64, here differences of large numbers are taken first, and
// covariances come from orthogonal vectors, whose squares lose nothing to cancellation.

override FANNED: bool; // scan lines run from the origin
override WRAP: bool; // the first one follows the last

const BLOCK = 128u; // consecutive Gaussians whose slices lie in one block of as many places
const TILE = 16; // rows and columns of a tile
const MAX_M2 = 11.0825270903; // -2 log(1/255): w and alpha are under 1/255 beyond
const MAX_M2_ATTENUATION = 9.0;
const MAX_WEIGHT = 0.999;
const MIN_PSI = 0.0039292930; // -log(1 - 1/255): alpha reaches 1/255
const FULL_PROFILE = 2.8906850; // G(u) for u >= 3
const LOG2_E = 1.4426950408889634;
const HALF_LOG2_E = 0.7213475204444817;

struct View {
    lateral: vec3f, // axes from the scene to lateral, elevation and axial places
    near: f32, // depth of the first row's upper edge
    elevation: vec3f,
    row: f32, // height of a row
    axial: vec3f,
    most: f32, // the last depth of a mean
    origin: vec3f,
    start: f32, // line j is at start + pitch (j + 1/2), in cm, or radians from the axial axis
    origin_rest: vec3f, // what float32 has lost of the origin
    pitch: f32,
    beam: vec4f, // the slice's variance: x + z (depth - y)^2, at most w
    planes: vec4i, // the places of B-mode, echo, transmittance and coverage among the planes; -1: not wanted
    volume: f32, // the determinant of the axes
    count: u32, // of Gaussians
    height: i32,
    width: i32,
}

// A Gaussian cut by the image plane: a 2D Gaussian about a scan line near its mean; t is across that line, r along it.
struct Slice {
    t: f32,
    past: f32, // how far the slice's own row lies behind its mean
    r: f32,
    m2: f32,
    tt: f32,
    tr: f32,
    rr: f32,
    det: f32,
    intensity: f32,
    absorb: f32, // 1 - tau
}

// The lines and rows that a slice may touch, and its own ones. All the way round, lines go on over the seam.
struct Extent {
    first: i32,
    last: i32,
    top: i32,
    bottom: i32,
    line: i32,
    row: i32,
    clipped: u32, // whether depth 0 clips its absorption
}

// All extents of a block.
struct Bounds {
    first: i32,
    last: i32,
    top: i32,
    bottom: i32,
    count: u32,
}

@group(0) @binding(0) var<uniform> view: View;

// From sums to planes: B = E T, E = (1 - exp(-S)) sum(I w) / (S + 1e-8), and T with the factors of the tiles above. A thread
// takes the rows of a tile on one scan line.

@group(0) @binding(1) var<storage, read> sums: array<f32>; // [3, H, W]
@group(0) @binding(2) var<storage, read> steps: array<f32>; // [tile rows, W]
@group(0) @binding(3) var<storage, read_write> planes: array<f32>; // those that are wanted, [H, W] each

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let column = i32(id.x);
    if (column >= view.width) { return; }
    let tile = i32(id.y);
    var handed = 1.0;
    for (var above = 0; above < tile; above++) { handed *= steps[above * view.width + column]; }
    let plane = view.height * view.width;
    for (var row = tile * TILE; row < min((tile + 1) * TILE, view.height); row++) {
        let pixel = row * view.width + column;
        let weight = sums[pixel];
        // 1 - exp loses digits where S is small.
        let share = select(1.0 - exp(-weight), weight * (1.0 - 0.5 * weight), weight <= 1e-3);
        let echo = share * sums[plane + pixel] / (weight + 1e-8);
        let transmittance = sums[2 * plane + pixel] * handed;
        if (view.planes.x >= 0) { planes[view.planes.x * plane + pixel] = echo * transmittance; }
        if (view.planes.y >= 0) { planes[view.planes.y * plane + pixel] = echo; }
        if (view.planes.z >= 0) { planes[view.planes.z * plane + pixel] = transmittance; }
        if (view.planes.w >= 0) { planes[view.planes.w * plane + pixel] = share; }
    }
}

// From Gaussians to slices: which of them the image plane cuts, and the 2D Gaussian each leaves there (docs/physics.md §5.2,
// §5.4). Computed in double: m2 and s* lose digits to cancellation otherwise, and a threshold that flips is a visible pixel.

namespace {

struct Candidates {
    int64_t ids[kLanes];
    int count = 0;
};

inline Floats spherical_harmonics(const SceneView& scene, const Candidates& c, Floats x, Floats y, Floats z) {
    const int degree = scene.sh_degree, terms = (degree + 1) * (degree + 1);
    Floats sh[kMaxShCoefficients] = {};
    for (int k = 0; k < c.count; ++k)
        for (int t = 0; t < terms; ++t) sh[t][k] = scene.sh[c.ids[k] * terms + t];
    Floats value = 0.28209479177387814f * sh[0];
    if (degree >= 1) value += 0.4886025119029199f * (z * sh[2] - y * sh[1] - x * sh[3]);
    if (degree >= 2) {
        value += 1.0925484305920792f * (x * y * sh[4] - y * z * sh[5] - x * z * sh[7]);
        value += 0.31539156525252005f * (2.0f * z * z - x * x - y * y) * sh[6];
        value += 0.5462742152960396f * (x * x - y * y) * sh[8];
    }
    if (degree >= 3) {
        value -= 0.5900435899266435f * (y * (3.0f * x * x - y * y) * sh[9] + x * (x * x - 3.0f * y * y) * sh[15]);
        value += 2.890611442640554f * x * y * z * sh[10];
        value -= 0.4570457994644658f * (4.0f * z * z - x * x - y * y) * (y * sh[11] + x * sh[13]);
        value += 0.3731763325901154f * z * (2.0f * z * z - 3.0f * x * x - 3.0f * y * y) * sh[12];
        value += 1.445305721320277f * z * (x * x - y * y) * sh[14];
    }
    return value;
}

inline Floats activate(Intensity kind, Floats value) {
    if (kind == Intensity::Sigmoid) return 1.0f / (1.0f + exponential(-4.0f * value));
    return minimum(maximum(value + 1.0f, splat(0.5f)), splat(0.999f));
}

// Scan lines whose ray comes within `room` of the slice in squared Mahalanobis distance. Widened by rounding to whole lines.
inline void touched_lines(const View& view, double room, Slice& s) {
    double first, last;
    if (!view.convex) {
        const double reach = __builtin_sqrt(room * s.cov_xx);
        first = ((s.mean_x - reach) / view.width + 0.5) * view.lines - 0.5;
        last = ((s.mean_x + reach) / view.width + 0.5) * view.lines - 0.5;
    } else {
        // The ellipse's tangents from the apex: roots in tan(angle).
        const double a = s.mean_z * s.mean_z - room * s.cov_zz, b = s.mean_x * s.mean_z - room * s.cov_xz;
        const double c = s.mean_x * s.mean_x - room * s.cov_xx, discriminant = b * b - a * c;
        if (!(a > 0) || !(discriminant >= 0)) {  // it reaches the plane of the apex
            first = 0, last = view.lines - 1;
        } else {
            const double root = __builtin_sqrt(discriminant);
            first = (__builtin_atan((b - root) / a) / view.opening + 0.5) * view.lines - 0.5;
            last = (__builtin_atan((b + root) / a) / view.opening + 0.5) * view.lines - 0.5;
        }
    }
    const double bound = view.lines - 1;
    first = first > 0 ? first : 0;
    last = last < bound ? last : bound;
    s.first = last < first - 1 ? view.lines : static_cast<int32_t>(first);  // truncation rounds down, `last` is rounded up
    s.last = last < first - 1 ? -1 : static_cast<int32_t>(last + 1 < bound ? last + 1 : bound);
}

inline bool inside_planes(const View& view, double x, double z) {
    const double depth = view.convex ? __builtin_sqrt(x * x + z * z) : z;
    return depth >= view.near && depth <= view.cull_far && (!view.convex || z > 0);
}

void slice_candidates(const SceneView& scene, const View& view, const Candidates& c, SliceList& out) {
    float mean[3][kLanes] = {}, scale[3][kLanes] = {}, quat[4][kLanes] = {};
    for (int k = 0; k < c.count; ++k) {
        const Gaussian& g = scene.gaussians[c.ids[k]];
        for (int d = 0; d < 3; ++d) mean[d][k] = g.mean[d], scale[d][k] = g.scale[d];
        for (int d = 0; d < 4; ++d) quat[d][k] = g.quat[d];
    }
    const auto widen = [](const float* p) { return __builtin_convertvector(load<Floats>(p), Doubles); };
    Doubles offset[3], mu[3];
    for (int d = 0; d < 3; ++d) offset[d] = widen(mean[d]) - view.origin[d];
    for (int d = 0; d < 3; ++d)
        mu[d] = view.axes[d][0] * offset[0] + view.axes[d][1] * offset[1] + view.axes[d][2] * offset[2];

    const Doubles w = widen(quat[0]), x = widen(quat[1]), y = widen(quat[2]), z = widen(quat[3]);
    const Doubles axes[3][3] = {
        {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
        {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
        {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)},
    };
    Doubles xx{}, xy{}, xz{}, yy{}, yz{}, zz{};
    for (int k = 0; k < 3; ++k) {  // covariance = sum over the Gaussian's own axes
        const Doubles s = widen(scale[k]);
        Doubles p[3];
        for (int d = 0; d < 3; ++d)
            p[d] = s * (view.axes[d][0] * axes[0][k] + view.axes[d][1] * axes[1][k] + view.axes[d][2] * axes[2][k]);
        xx += p[0] * p[0], xy += p[0] * p[1], xz += p[0] * p[2];
        yy += p[1] * p[1], yz += p[1] * p[2], zz += p[2] * p[2];
    }
    const Doubles inverse_yy = 1.0 / yy, shift = -mu[1] * inverse_yy;  // condition on the plane, y = 0
    const Doubles m2 = mu[1] * mu[1] * inverse_yy;
    const Doubles mean_x = mu[0] + xy * shift, mean_z = mu[2] + yz * shift;
    const Doubles cov_xx = xx - xy * xy * inverse_yy, cov_xz = xz - xy * yz * inverse_yy;
    const Doubles cov_zz = zz - yz * yz * inverse_yy;

    const Floats vx = to_floats(offset[0]), vy = to_floats(offset[1]), vz = to_floats(offset[2]);
    const Floats length2 = vx * vx + vy * vy + vz * vz;
    const Floats inverse_length = 1.0f / square_root(maximum(length2, splat(1e-36f)));
    const Floats value = spherical_harmonics(scene, c, vx * inverse_length, vy * inverse_length, vz * inverse_length);
    const Floats intensity = activate(scene.intensity, value);

    Slice* next = out.append(c.count);
    int written = 0;
    for (int k = 0; k < c.count; ++k) {
        if (!(m2[k] <= kMaxM2) || !inside_planes(view, mu[0][k], mu[2][k])) continue;
        if (!(cov_xx[k] > 0 && cov_xx[k] * cov_zz[k] > cov_xz[k] * cov_xz[k])) continue;  // thinner than double can tell
        Slice& s = next[written];
        s.mean_x = mean_x[k], s.mean_z = mean_z[k];
        s.cov_xx = cov_xx[k], s.cov_xz = cov_xz[k], s.cov_zz = cov_zz[k];
        s.depth = view.convex ? __builtin_sqrt(s.mean_x * s.mean_x + s.mean_z * s.mean_z) : s.mean_z;
        touched_lines(view, kMaxM2 - m2[k], s);
        if (s.first > s.last) continue;
        s.m2_plane = static_cast<float>(m2[k]);
        s.intensity = intensity[k];
        s.absorb = scene.gaussians[c.ids[k]].absorb;
        ++written;
    }
    out.shrink_by(c.count - written);
}

void slice_clusters(const SceneView& scene, const View& view, int64_t first, int64_t last, SliceList& out) {
    const float ny[3] = {float(view.axes[1][0]), float(view.axes[1][1]), float(view.axes[1][2])};
    const float o[3] = {float(view.origin[0]), float(view.origin[1]), float(view.origin[2])};
    // The culls here only save work; they are widened by what float32 may be off.
    const float far = view.cull_far < 1e6 ? float(view.cull_far) : 1e6f;  // infinite for one row
    const float slack = 1e-6f * (1.0f + far + __builtin_fabsf(o[0]) + __builtin_fabsf(o[1]) + __builtin_fabsf(o[2]));
    Candidates found;
    for (int64_t i = first; i < last; ++i) {
        const Cluster& cluster = scene.clusters[i];
        float distance = 0, extent = slack + cluster.reach;
        for (int d = 0; d < 3; ++d) {
            distance += ny[d] * (cluster.centre[d] - o[d]);
            extent += __builtin_fabsf(ny[d]) * cluster.half[d];
        }
        if (__builtin_fabsf(distance) > extent) continue;
        const int64_t begin = i * kClusterSize;
        const int64_t end = begin + kClusterSize < scene.count ? begin + kClusterSize : scene.count;
        for (int64_t g = begin; g < end; ++g) {
            const Gaussian& gaussian = scene.gaussians[g];
            float height = 0;
            for (int d = 0; d < 3; ++d) height += ny[d] * (gaussian.mean[d] - o[d]);
            found.ids[found.count] = g;
            found.count += __builtin_fabsf(height) <= gaussian.reach + slack;
            if (found.count == kLanes) {
                slice_candidates(scene, view, found, out);
                found.count = 0;
            }
        }
    }
    if (found.count > 0) slice_candidates(scene, view, found, out);
}

}  // namespace

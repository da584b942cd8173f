// From Gaussians to slices: which of them the image plane cuts, and the 2D Gaussian each leaves there (docs/physics.md
// §5.2). Computed in double: m2 and s* lose digits to cancellation otherwise, and a threshold that flips is a visible pixel.

#pragma once

#include "displace.inl"

namespace {

struct Candidates {
    int64_t ids[kLanes];
    int count = 0;
};

struct Harmonics {
    Floats coefficients[kMaxShCoefficients];
};

inline Harmonics load_harmonics(const SceneView& scene, const Candidates& c) {
    const int terms = (scene.sh_degree + 1) * (scene.sh_degree + 1);
    Harmonics sh;
    for (int t = 0; t < terms; ++t) {
        sh.coefficients[t] = Floats{};
        for (int k = 0; k < c.count; ++k) sh.coefficients[t][k] = scene.sh[c.ids[k] * terms + t];
    }
    return sh;
}

inline Floats spherical_harmonics(const Harmonics& harmonics, int degree, Floats x, Floats y, Floats z) {
    const Floats* sh = harmonics.coefficients;
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
    const auto line_at = [&view](double across) { return (across - view.start) / view.span * view.lines - 0.5; };
    double first, last;
    if (!view.fanned) {
        const double reach = __builtin_sqrt(room * s.cov_xx);
        first = line_at(s.mean_x - reach), last = line_at(s.mean_x + reach);
    } else {
        // The ellipse's tangents from the apex: roots in tan(angle).
        const double a = s.mean_z * s.mean_z - room * s.cov_zz, b = s.mean_x * s.mean_z - room * s.cov_xz;
        const double c = s.mean_x * s.mean_x - room * s.cov_xx, discriminant = b * b - a * c;
        if (!(a > 0) || !(discriminant >= 0)) {  // it reaches the plane of the apex
            first = 0, last = view.lines - 1;
        } else {
            const double root = __builtin_sqrt(discriminant);
            first = line_at(__builtin_atan((b - root) / a)), last = line_at(__builtin_atan((b + root) / a));
        }
    }
    const double bound = view.lines - 1;
    first = first > 0 ? first : 0;
    last = last < bound ? last : bound;
    s.first = last < first - 1 ? view.lines : static_cast<int32_t>(first);  // truncation rounds down, `last` is rounded up
    s.last = last < first - 1 ? -1 : static_cast<int32_t>(last + 1 < bound ? last + 1 : bound);
}

// The same of lines all the way round, in the axes of the line through the mean, where r is its distance from the apex, tt
// the variance across that line, and so on. A slice that lies on the seam has its first line behind its last.
inline void touched_lines_of_turn(const View& view, double room, Slice& s) {
    const double r = s.depth, ex = r > 0 ? s.mean_x / r : 0.0, ez = r > 0 ? s.mean_z / r : 1.0;
    const double tt = ez * ez * s.cov_xx - 2 * ex * ez * s.cov_xz + ex * ex * s.cov_zz;
    const double tr = ex * ez * (s.cov_xx - s.cov_zz) + s.cov_xz * (ez * ez - ex * ex);
    const double rr = ex * ex * s.cov_xx + 2 * ex * ez * s.cov_xz + ez * ez * s.cov_zz;
    const double a = r * r - room * rr, b = -room * tr, discriminant = b * b + a * room * tt;
    s.first = 0, s.last = view.lines - 1;
    if (!(a > 0) || !(discriminant >= 0)) return;  // it reaches behind the apex
    const double root = __builtin_sqrt(discriminant), pitch = view.span / view.lines;
    const double own = (__builtin_atan2(ex, ez) - view.start) / pitch - 0.5;
    const double first = __builtin_floor(own + __builtin_atan((b - root) / a) / pitch);
    const double last = __builtin_ceil(own + __builtin_atan((b + root) / a) / pitch);
    if (!(last - first + 1 + kMaxLanes <= view.lines)) return;  // a vector that starts before the seam must not come round
    const auto wrapped = [&view](double line) {
        const int32_t turned = static_cast<int32_t>(line) % view.lines;
        return turned < 0 ? turned + view.lines : turned;
    };
    s.first = wrapped(first), s.last = wrapped(last);
}

inline bool inside_planes(const View& view, double x, double z) {
    const double depth = view.fanned ? __builtin_sqrt(x * x + z * z) : z;
    return depth >= view.cull_near && depth <= view.cull_far && (!view.fanned || view.wrap || z > 0);
}

// kLanes Gaussians seen in the probe frame.
template <class Reals>
struct Placed {
    Reals quat[4];
    Reals offset[3];   // of the mean from the probe's origin, in the scene's axes
    Reals mu[3];       // the mean, in the probe's axes
    Reals axes[3][3];  // columns: the Gaussian's own axes, in the scene's
    Reals scale[3];
    Reals map[3][3];               // F of displaced tissue; its own axis times its scale becomes F times that
    Reals spoke[3][3];             // each own axis times its scale, in the probe's axes
    Reals xx, xy, xz, yy, yz, zz;  // covariance: the sum of the spokes' outer products
};

template <class Reals, bool displaced>
inline Placed<Reals> place(const SceneView& scene, const View& view, const Candidates& c) {
    float mean[3][kLanes], scale[3][kLanes], quat[4][kLanes];
    for (int k = 0; k < kLanes; ++k) {
        const Gaussian& g = scene.gaussians[c.ids[k < c.count ? k : 0]];
        for (int d = 0; d < 3; ++d) mean[d][k] = g.mean[d], scale[d][k] = g.scale[d];
        for (int d = 0; d < 4; ++d) quat[d][k] = g.quat[d];
    }
    const auto convert = [](auto vector) { return __builtin_convertvector(vector, Reals); };
    Placed<Reals> p;
    Doubles offset[3];  // a small difference of large numbers, and so are the mean's places
    for (int d = 0; d < 3; ++d) offset[d] = __builtin_convertvector(load<Floats>(mean[d]), Doubles);
    if constexpr (displaced) {
        Floats map[3][3];
        set_identity(map);
        for (int f = 0; f < view.field_count; ++f) displace_by(view.fields[f], c.count, offset, map);
        for (int d = 0; d < 3; ++d)
            for (int e = 0; e < 3; ++e) p.map[d][e] = convert(map[d][e]);
    }
    for (int d = 0; d < 3; ++d) offset[d] -= view.origin[d];
    for (int d = 0; d < 3; ++d) p.offset[d] = convert(offset[d]);
    for (int d = 0; d < 3; ++d)
        p.mu[d] = convert(splat_double(view.axes[d][0]) * offset[0] + splat_double(view.axes[d][1]) * offset[1] +
                          splat_double(view.axes[d][2]) * offset[2]);

    for (int d = 0; d < 4; ++d) p.quat[d] = convert(load<Floats>(quat[d]));
    const Reals w = p.quat[0], x = p.quat[1], y = p.quat[2], z = p.quat[3];
    p.axes[0][0] = 1 - 2 * (y * y + z * z), p.axes[0][1] = 2 * (x * y - w * z), p.axes[0][2] = 2 * (x * z + w * y);
    p.axes[1][0] = 2 * (x * y + w * z), p.axes[1][1] = 1 - 2 * (x * x + z * z), p.axes[1][2] = 2 * (y * z - w * x);
    p.axes[2][0] = 2 * (x * z - w * y), p.axes[2][1] = 2 * (y * z + w * x), p.axes[2][2] = 1 - 2 * (x * x + y * y);
    p.xx = p.xy = p.xz = p.yy = p.yz = p.zz = Reals{};
    for (int k = 0; k < 3; ++k) {
        p.scale[k] = convert(load<Floats>(scale[k]));
        Reals own[3] = {p.axes[0][k], p.axes[1][k], p.axes[2][k]};
        if constexpr (displaced)
            for (int d = 0; d < 3; ++d)
                own[d] = p.map[d][0] * p.axes[0][k] + p.map[d][1] * p.axes[1][k] + p.map[d][2] * p.axes[2][k];
        for (int d = 0; d < 3; ++d) {
            const Reals along[3] = {splat_any<Reals>(view.axes[d][0]), splat_any<Reals>(view.axes[d][1]),
                                    splat_any<Reals>(view.axes[d][2])};
            p.spoke[k][d] = p.scale[k] * (along[0] * own[0] + along[1] * own[1] + along[2] * own[2]);
        }
        const Reals* s = p.spoke[k];
        p.xx += s[0] * s[0], p.xy += s[0] * s[1], p.xz += s[0] * s[2];
        p.yy += s[1] * s[1], p.yz += s[1] * s[2], p.zz += s[2] * s[2];
    }
    return p;
}

// The beam's spread along elevation (docs/physics.md §3): S' = S + variance e eT.
struct Spread {
    Doubles offset;     // of the mean's depth from the focus
    Doubles variance;   // there
    Doubles precision;  // eT S^-1 e
    Doubles ratio;      // |S'| / |S|
    Doubles normal[3];  // S^-1 e, of displaced tissue
};

template <bool displaced>
inline Spread spread_along_elevation(const View& view, Placed<Doubles>& p) {
    Spread t{};
    t.offset = p.mu[2];
    if (view.fanned)
        for (int k = 0; k < kLanes; ++k) t.offset[k] = __builtin_sqrt(p.mu[0][k] * p.mu[0][k] + p.mu[2][k] * p.mu[2][k]);
    t.offset -= view.beam.focus;
    t.variance = view.beam.at_focus + view.beam.slope2 * t.offset * t.offset;
    if constexpr (displaced) {  // the spokes are not at right angles
        const Doubles x = p.xz * p.yz - p.xy * p.zz, y = p.xx * p.zz - p.xz * p.xz, z = p.xy * p.xz - p.xx * p.yz;
        const Doubles determinant = p.xy * x + p.yy * y + p.yz * z;
        t.normal[0] = x / determinant, t.normal[1] = y / determinant, t.normal[2] = z / determinant;
        t.precision = t.normal[1];
    } else {
        for (int k = 0; k < 3; ++k) {
            const Doubles along = p.spoke[k][1] / (p.scale[k] * p.scale[k]);
            t.precision += along * along;
        }
    }
    t.ratio = 1.0 + t.variance * t.precision;
    p.yy += t.variance;
    return t;
}

// The direction of view, 0 at the probe's own origin.
struct Direction {
    Floats x, y, z, inverse_length;
};

template <class Reals>
inline Direction direction_of(const Reals offset[3]) {
    const Floats x = to_floats(offset[0]), y = to_floats(offset[1]), z = to_floats(offset[2]);
    const Floats inverse_length = 1.0f / square_root(maximum(x * x + y * y + z * z, splat(1e-36f)));
    return {x * inverse_length, y * inverse_length, z * inverse_length, inverse_length};
}

// Apart for a slice without thickness, so that it costs nothing there.
template <bool thick, bool displaced>
void slice_candidates(const SceneView& scene, const View& view, const Candidates& c, SliceList& out) {
    Placed<Doubles> p = place<Doubles, displaced>(scene, view, c);
    Doubles lost{};  // what m2 grows by, as the beam's weight spreads, and by a Gaussian's own weight
    if (thick) {
        const Spread spread = spread_along_elevation<displaced>(view, p);
        for (int k = 0; k < c.count; ++k) lost[k] = __builtin_log(spread.ratio[k]);
    }
    if (scene.weighted)
        for (int k = 0; k < c.count; ++k) lost[k] -= 2.0 * __builtin_log(1.0 - scene.gaussians[c.ids[k]].absorb);
    const Doubles inverse_yy = 1.0 / p.yy, shift = -p.mu[1] * inverse_yy;  // condition on the plane, y = 0
    const Doubles m2 = p.mu[1] * p.mu[1] * inverse_yy + lost;
    const Doubles mean_x = p.mu[0] + p.xy * shift, mean_z = p.mu[2] + p.yz * shift;
    const Doubles cov_xx = p.xx - p.xy * p.xy * inverse_yy, cov_xz = p.xz - p.xy * p.yz * inverse_yy;
    const Doubles cov_zz = p.zz - p.yz * p.yz * inverse_yy;
    const Direction v = direction_of(p.offset);
    const Floats value = spherical_harmonics(load_harmonics(scene, c), scene.sh_degree, v.x, v.y, v.z);
    const Floats intensity = activate(scene.intensity, value);

    const int room = view.wrap ? 2 * c.count : c.count;
    Slice* next = out.append(room);
    int written = 0;
    for (int k = 0; k < c.count; ++k) {
        if (!(m2[k] <= kMaxM2) || !inside_planes(view, p.mu[0][k], p.mu[2][k])) continue;
        if (!(cov_xx[k] > 0 && cov_xx[k] * cov_zz[k] > cov_xz[k] * cov_xz[k])) continue;  // thinner than double can tell
        Slice& s = next[written];
        s.mean_x = mean_x[k], s.mean_z = mean_z[k];
        s.cov_xx = cov_xx[k], s.cov_xz = cov_xz[k], s.cov_zz = cov_zz[k];
        s.depth = view.fanned ? __builtin_sqrt(s.mean_x * s.mean_x + s.mean_z * s.mean_z) : s.mean_z;
        if (view.wrap)
            touched_lines_of_turn(view, kMaxM2 - m2[k], s);
        else
            touched_lines(view, kMaxM2 - m2[k], s);
        if (s.first > s.last && !view.wrap) continue;
        s.m2_plane = static_cast<float>(m2[k]);
        s.intensity = intensity[k];
        s.absorb = view.absorbs ? scene.gaussians[c.ids[k]].absorb : 0.0f;
        s.gaussian = static_cast<int32_t>(c.ids[k]);
        ++written;
        if (s.first <= s.last) {
            out.lines += s.last - s.first + 1;
            continue;
        }
        out.lines += view.lines + s.last - s.first + 1;
        next[written] = s;  // on the seam: once for either side of it
        next[written].first = 0;
        s.last = view.lines - 1;
        ++written;
    }
    out.shrink_by(room - written);
}

// Bounds of a field within so much of a coordinate along the third axis of its grid.
inline Layer layer_about(const Field& field, double coordinate, double room) {
    const auto cell = [most = field.size[2] - 4](double at) {
        return at < 2 ? 0 : at < most + 1 ? static_cast<int>(at) - 1 : most;
    };
    Layer layer = field.layers[cell(coordinate - room)];
    for (int k = cell(coordinate - room) + 1; k <= cell(coordinate + room); ++k) layer.widen(field.layers[k]);
    return layer;
}

// Of the displacement of the means of up to kLanes clusters: that of each centre tells it to first order.
inline void displacements_of(const SceneView& scene, const View& view, const Candidates& clusters, Layer bounds[kLanes]) {
    float centre[3][kLanes], radius[kLanes], steepest = 1;
    for (int k = 0; k < kLanes; ++k) {
        const Cluster& cluster = scene.clusters[clusters.ids[k < clusters.count ? k : 0]];
        float squares = 0;
        for (int d = 0; d < 3; ++d) centre[d][k] = cluster.centre[d], squares += cluster.half[d] * cluster.half[d];
        radius[k] = __builtin_sqrtf(squares), bounds[k] = {};
    }
    Doubles x[3];
    for (int d = 0; d < 3; ++d) x[d] = __builtin_convertvector(load<Floats>(centre[d]), Doubles);
    for (int f = 0; f < view.field_count; ++f) {
        const Field& field = view.fields[f];
        const double* row = field.to_grid[2];
        const double per_cm = __builtin_sqrt(row[0] * row[0] + row[1] * row[1] + row[2] * row[2]);
        double depths[kLanes];
        store(depths, coordinate_of(row, x));
        for (int k = 0; k < clusters.count; ++k) {
            const Layer layer = layer_about(field, depths[k], steepest * radius[k] * per_cm);
            bounds[k].least += layer.least, bounds[k].most += layer.most;
            bounds[k].gradient = steepest * (1 + layer.gradient) - 1, bounds[k].stretch = steepest * layer.stretch;
        }
        steepest *= field.steepest;
        Fielded at;
        field_at(field, x, clusters.count, at);
        move(x, at);
    }
    Doubles along{};
    for (int d = 0; d < 3; ++d)
        along += splat_double(view.axes[1][d]) * (x[d] - __builtin_convertvector(load<Floats>(centre[d]), Doubles));
    float moved[kLanes];
    store(moved, to_floats(along));
    for (int k = 0; k < clusters.count; ++k) {
        const float room = bounds[k].gradient * radius[k];
        bounds[k].least = bounds[k].least < moved[k] - room ? moved[k] - room : bounds[k].least;
        bounds[k].most = moved[k] + room < bounds[k].most ? moved[k] + room : bounds[k].most;
    }
}

template <bool thick, bool displaced>
void slice_clusters_of(const SceneView& scene, const View& view, int64_t first, int64_t last, SliceList& out) {
    const float ny[3] = {float(view.axes[1][0]), float(view.axes[1][1]), float(view.axes[1][2])};
    const float o[3] = {float(view.origin[0]), float(view.origin[1]), float(view.origin[2])};
    // The culls here only save work; they are widened by what float32 may be off.
    const float far = float(view.near + view.row_step * view.height);
    const float slack = 1e-6f * (1.0f + far + __builtin_fabsf(o[0]) + __builtin_fabsf(o[1]) + __builtin_fabsf(o[2]));
    // A reach of 3.33 standard deviations; variances add up.
    const float beam_reach2 = float(kMaxM2 * (1 + 1e-5) * view.beam.most);
    const auto reach_of = [beam_reach2](float reach) {
        return thick ? __builtin_sqrtf(reach * reach + beam_reach2) : reach;
    };
    const auto is_off = [&](int64_t i, const Layer& moved) {
        const Cluster& cluster = scene.clusters[i];
        float distance = 0, extent = slack;
        for (int d = 0; d < 3; ++d) {
            distance += ny[d] * (cluster.centre[d] - o[d]);
            extent += __builtin_fabsf(ny[d]) * cluster.half[d];
        }
        extent += reach_of(moved.stretch * cluster.reach);
        return distance + moved.most < -extent || distance + moved.least > extent;
    };
    Candidates found;
    const auto slice_cluster = [&](int64_t i, const Layer& moved) {
        const float middle = 0.5f * (moved.least + moved.most), doubt = slack + 0.5f * (moved.most - moved.least);
        const int64_t begin = i * kClusterSize;
        const int64_t end = begin + kClusterSize < scene.count ? begin + kClusterSize : scene.count;
        for (int64_t g = begin; g < end; ++g) {
            const Gaussian& gaussian = scene.gaussians[g];
            float height = middle;
            for (int d = 0; d < 3; ++d) height += ny[d] * (gaussian.mean[d] - o[d]);
            found.ids[found.count] = g;
            found.count += __builtin_fabsf(height) <= reach_of(moved.stretch * gaussian.reach) + doubt;
            if (found.count == kLanes) {
                slice_candidates<thick, displaced>(scene, view, found, out);
                found.count = 0;
            }
        }
    };
    Candidates near{};  // clusters
    for (int64_t i = first; i < last; ++i) {
        if constexpr (!displaced) {
            constexpr Layer still{0, 0, 0, 1};
            if (!is_off(i, still)) slice_cluster(i, still);
        } else {
            near.ids[near.count] = i;
            near.count += !is_off(i, view.displaced);
            if (near.count < kLanes && i + 1 < last) continue;
            Layer moved[kLanes];
            displacements_of(scene, view, near, moved);
            for (int k = 0; k < near.count; ++k)
                if (!is_off(near.ids[k], moved[k])) slice_cluster(near.ids[k], moved[k]);
            near.count = 0;
        }
    }
    if (found.count > 0) slice_candidates<thick, displaced>(scene, view, found, out);
}

void slice_clusters(const SceneView& scene, const View& view, int64_t first, int64_t last, SliceList& out) {
    const auto slice = [&](auto thick) {
        (view.field_count ? slice_clusters_of<thick, true> : slice_clusters_of<thick, false>)(scene, view, first, last, out);
    };
    if (view.beam.is_thick())
        slice(std::true_type{});
    else
        slice(std::false_type{});
}

}  // namespace

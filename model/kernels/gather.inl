// The backward pass (docs/physics.md §4, §5.6): from the loss's gradients on pixels to those on Gaussians. Every slice reads
// its own footprint, so nothing is added to from two sides. Thresholds and culls are held fixed; all else is the true
// gradient.

#pragma once

#include "draw.inl"
#include "slice.inl"

namespace {

// (1 - exp(-S)) S / (S (S + 1e-8)) is the factor of sum(I w) in E; its value and its derivative by S.
struct EchoFactor {
    Floats value, slope;
};

inline EchoFactor echo_factor(Floats sum) {
    const Floats inverse = 1.0f / maximum(sum, splat(1e-30f)), guarded = 1.0f / (sum + 1e-8f);
    const Floats left = exponential(-sum);
    const Mask small = less_equal(sum, splat(0.03f));  // differences of nearly equal numbers there
    const Floats ratio =
        select(small, 1.0f - sum * (0.5f - sum * (1.0f / 6.0f - sum * (1.0f / 24.0f))), (1.0f - left) * inverse);
    const Floats ratio_slope =
        select(small, sum * (1.0f / 3.0f - sum * (0.125f - sum * (1.0f / 30.0f))) - 0.5f, (left - ratio) * inverse);
    const Floats share = sum * guarded;
    return {ratio * share, ratio_slope * share + ratio * (1e-8f * guarded * guarded)};
}

void differentiate(const View& view, int first, int lines, const SavedPlanes& saved, const Outputs& gradients,
                   const PixelGradients& out) {
    const auto take = [&](const float* plane, int row, int line) {
        if (plane == nullptr) return Floats{};
        const float* from = plane + int64_t(row) * view.lines + line;
        if (line + kLanes <= view.lines) return load<Floats>(from);
        float lanes[kLanes] = {};
        for (int k = 0; line + k < view.lines; ++k) lanes[k] = from[k];
        return load<Floats>(lanes);
    };
    for (int line = first; line < first + lines; line += kLanes) {
        Floats below{};
        for (int row = view.height - 1; row >= 0; --row) {
            const int64_t at = int64_t(row) * saved.stride + line;
            const Floats sum = load<Floats>(saved.weight + at), weighted = load<Floats>(saved.intensity + at);
            const Floats transmittance = load<Floats>(saved.transmittance + at);
            const Floats by_bmode = take(gradients.bmode, row, line);
            const EchoFactor factor = echo_factor(sum);
            const Floats by_echo = take(gradients.echo, row, line) + by_bmode * transmittance;
            const Floats echo = factor.value * weighted;
            const Floats by_log = (take(gradients.transmittance, row, line) + by_bmode * echo) * transmittance;
            const Floats by_coverage = take(gradients.coverage, row, line);
            below += by_log;
            const int64_t to = int64_t(row) * out.stride + line;
            const Floats by_sum = by_echo * weighted * factor.slope + by_coverage * exponential(-sum);
            store(out.weight + to, by_sum + take(gradients.weight_sum, row, line));
            store(out.intensity + to, by_echo * factor.value + take(gradients.intensity_sum, row, line));
            store(out.log_transmittance + to, by_log);
            store(out.below + to, below);
        }
    }
    if (first + lines < view.lines) return;
    for (int row = 0; row < view.height; ++row)  // groups reach beyond the last line
        for (int64_t k = int64_t(row) * out.stride + view.lines; k < int64_t(row + 1) * out.stride; ++k)
            out.weight[k] = out.intensity[k] = out.log_transmittance[k] = out.below[k] = 0.0f;
}

// G and its derivatives by u and by where depth 0 lies.
struct ProfileSlopes {
    Floats value, by_u, by_zero;
};

inline ProfileSlopes clipped_slopes(Floats u, Floats zero) {
    const Floats one = splat(1.0f), start = maximum(zero, Floats{});
    const Mask above = less_equal(u, start);  // the centre of the window is at u itself
    const Floats centre = minimum(start, u);
    const Floats centre_by_u = keep(above, one),
                 centre_by_zero = select(above, Floats{}, keep(less_equal(Floats{}, zero), one));
    const Mask cut = less_equal(centre - 3.0f, zero), open = less_equal(u, centre + 3.0f);
    const Floats low = maximum(centre - 3.0f, zero), high = minimum(centre + 3.0f, u);
    const Floats low_by_u = select(cut, Floats{}, centre_by_u), low_by_zero = select(cut, one, centre_by_zero);
    const Floats high_by_u = select(open, one, centre_by_u), high_by_zero = select(open, Floats{}, centre_by_zero);

    const Floats half = 0.5f * (high - low), middle = 0.5f * (high + low);
    Floats sum{}, by_half{}, by_middle{};
    const auto add = [&](float node, float weight) {
        const Floats t = middle + node * half, density = weight * exponential(-0.5f * t * t);
        sum += density, by_middle -= half * t * density, by_half -= half * node * t * density;
    };
    add(0.0f, 8.0f / 9.0f), add(-kNode, 5.0f / 9.0f), add(kNode, 5.0f / 9.0f);
    by_half += sum;
    const Floats by_low = 0.5f * (by_middle - by_half), by_high = 0.5f * (by_middle + by_half);

    const Floats depth = u - zero, point = 0.5f * (u + zero), density = exponential(-0.5f * point * point);
    const Mask degenerate = either(less_equal(depth * depth, splat(1e-8f)), less_equal(high, low));
    const Floats bend = 0.5f * depth * point * density;
    return {select(degenerate, depth * density, half * sum),
            select(degenerate, density - bend, by_low * low_by_u + by_high * high_by_u),
            select(degenerate, -density - bend, by_low * low_by_zero + by_high * high_by_zero)};
}

// Sums over the rows of a group, each a derivative of the loss with respect to what it is named after.
struct LineSums {
    Floats intensity{}, absorb{};
    Floats u{}, u_times_u{};  // by u of each row; that times u
    Floats weight{}, psi{};   // by each weight and psi, times its value
    Floats zero{};

    void operator+=(const LineSums& other) {
        intensity += other.intensity, absorb += other.absorb;
        u += other.u, u_times_u += other.u_times_u;
        weight += other.weight, psi += other.psi;
        zero += other.zero;
    }
};

// `simple` as in draw_rows.
template <Profile profile, bool simple>
inline LineSums gather_rows(const Group& group, const Slice& s, const PixelGradients& pixels, int line, int top, int end) {
    const Group g = group;  // its own: what is loaded below could be anything to the compiler
    LineSums sums;
    constexpr bool capped = profile != Profile::Thin;  // else alpha stays far below its limit
    const int period = restart_period(g);
    const Floats q = exponential(-g.du * g.du);
    const Floats intensity = splat(s.intensity), absorb = splat(s.absorb);
    for (int block = top; block < end; block += period) {
        Floats steps = splat(float(block - g.base));
        Floats u = g.u + steps * g.du;
        Floats w = exponential(-0.5f * (g.m2 + u * u));
        Floats r = exponential(-g.du * (u + 0.5f * g.du));
        const int stop = block + period < end ? block + period : end;
        for (int i = block; i < stop; ++i) {
            ProfileSlopes shape{};
            Floats psi{};
            if (profile == Profile::Clipped)
                shape = clipped_slopes(u, g.zero);
            else if (profile != Profile::None)
                shape = {absorption_profile(u), profile_slope(u), Floats{}};
            if (profile != Profile::None) psi = g.peak * shape.value;
            const Mask near = less_equal(u * u, g.window2);
            const Mask counted = simple                     ? within(g.first, u, g.last)
                                 : profile == Profile::None ? near
                                                            : either(near, less_equal(splat(kMinPsi), psi));

            const int64_t at = int64_t(i) * pixels.stride + line;
            const Floats by_intensity = load<Floats>(pixels.intensity + at);
            const Floats weight = keep(counted, simple ? w : minimum(w, splat(kMaxWeight)));
            sums.intensity += by_intensity * weight;
            Floats weighed = (load<Floats>(pixels.weight + at) + intensity * by_intensity) * weight;
            if (!simple) weighed = keep(less_equal(w, splat(kMaxWeight)), weighed);
            sums.weight += weighed;
            Floats by_u = -(u * weighed);
            if (profile != Profile::None) {
                const Floats alpha = capped ? 1.0f - exponential(-psi) : psi * (1.0f - psi * (0.5f - psi * (1.0f / 6.0f)));
                const Floats stopped = capped ? minimum(alpha, splat(kMaxWeight)) : alpha;
                const Floats by_factor =
                    keep(counted, load<Floats>(pixels.log_transmittance + at) / (1.0f - absorb * stopped));
                sums.absorb -= by_factor * stopped;
                Floats by_psi = -absorb * by_factor * (1.0f - alpha);
                if (capped) by_psi = keep(less_equal(alpha, splat(kMaxWeight)), by_psi);
                sums.psi += psi * by_psi;
                by_u += by_psi * g.peak * shape.by_u;
                if (profile == Profile::Clipped) sums.zero += by_psi * g.peak * shape.by_zero;
            }
            sums.u += by_u;
            sums.u_times_u += by_u * u;
            w *= r;
            r *= q;
            steps += 1.0f;
            u = g.u + steps * g.du;
        }
    }
    return sums;
}

// With respect to a slice, summed over lanes.
struct SliceGradient {
    Floats mean_x{}, mean_z{}, cov_xx{}, cov_xz{}, cov_zz{}, m2_plane{}, intensity{}, absorb{};
};

inline void gather_group(const View& view, const Slice& s, const Course& course, const PixelGradients& pixels, int line,
                         SliceGradient& out) {
    const Group g = cross(view, s, course, line);
    if (!any(g.touched)) return;
    const Extent extent = extent_of(view, g);
    const int top = extent.top, clear = extent.clear, end = extent.end;
    const auto rows = [&](auto profile, int from, int to) {
        return (extent.simple ? gather_rows<profile, true> : gather_rows<profile, false>)(g, s, pixels, line, from, to);
    };
    __builtin_prefetch(pixels.below + int64_t(end) * pixels.stride + line);
    LineSums sums;
    if (!view.absorbs)
        sums = rows(std::integral_constant<Profile, Profile::None>{}, top, end);
    else if (extent.thick)
        sums = rows(std::integral_constant<Profile, Profile::Thick>{}, clear, end);
    else
        sums = rows(std::integral_constant<Profile, Profile::Thin>{}, clear, end);
    if (view.absorbs && top < clear) sums += gather_rows<Profile::Clipped, false>(g, s, pixels, line, top, clear);
    if (end < view.height && any(g.opaque)) {
        ProfileSlopes shape = {splat(kFullG), Floats{}, Floats{}};
        if (extent.clipped) shape = clipped_slopes(extent.whole + 1.0f, g.zero);  // constant in u there
        const Floats psi = g.peak * shape.value;
        const Mask passes = less_equal(splat(kMinPsi), psi);
        const Floats alpha = 1.0f - exponential(-psi), capped = minimum(alpha, splat(kMaxWeight));
        const Floats steps = load<Floats>(pixels.below + int64_t(end) * pixels.stride + line);
        const Floats by_factor = keep(passes, steps / (1.0f - s.absorb * capped));
        sums.absorb -= by_factor * capped;
        const Floats by_psi = keep(less_equal(alpha, splat(kMaxWeight)), -s.absorb * by_factor * (1.0f - alpha));
        sums.psi += psi * by_psi;
        sums.zero += by_psi * g.peak * shape.by_zero;
    }

    // u = (s - s*) / sigma, zero = -s* / sigma, psi = exp(-m2/2) sigma G(u, zero).
    const Floats inverse_sigma = 1.0f / g.sigma;
    const Floats by_star = -(sums.u + sums.zero) * inverse_sigma;
    const Floats by_variance = 0.5f * (sums.psi - sums.u_times_u - sums.zero * g.zero) * inverse_sigma * inverse_sigma;
    const Floats by_m2 = -0.5f * (sums.weight + sums.psi);

    // With a the line's normal in the plane and e its direction: m2 = across2 / q, s* = e.mean - k across / q and
    // variance = det / q, where q = a.C a, k = a.C e and det = det C.
    const Floats xx = splat(float(s.cov_xx)), xz = splat(float(s.cov_xz)), zz = splat(float(s.cov_zz));
    const Floats variance = g.sigma * g.sigma, slant = g.across * g.spread;
    const Floats by_det = by_variance * g.spread;
    const Floats by_k = -by_star * slant;
    const auto by_across = [&](Floats k) { return 2.0f * by_m2 * slant - by_star * k * g.spread; };
    const auto by_q = [&](Floats k) {
        return (by_star * k * slant - by_variance * variance) * g.spread - by_m2 * slant * slant;
    };
    const auto add = [&](Floats& sum, Floats value) { sum += keep(g.touched, value); };
    if (view.fanned) {
        const Floats dx = to_floats(load<Doubles>(view.dir_x + line)), dz = to_floats(load<Doubles>(view.dir_z + line));
        const Floats k = dx * dz * (zz - xx) + xz * (dx * dx - dz * dz), across = by_across(k), q = by_q(k);
        add(out.mean_x, dx * by_star - dz * across);
        add(out.mean_z, dz * by_star + dx * across);
        add(out.cov_xx, q * dz * dz - by_k * dx * dz + by_det * zz);
        add(out.cov_xz, by_k * (dx * dx - dz * dz) - 2.0f * (q * dx * dz + by_det * xz));
        add(out.cov_zz, q * dx * dx + by_k * dx * dz + by_det * xx);
    } else {  // e is z
        add(out.mean_x, -by_across(-xz));
        add(out.mean_z, by_star);
        add(out.cov_xx, by_q(-xz) + by_det * zz);
        add(out.cov_xz, -by_k - 2.0f * by_det * xz);
        add(out.cov_zz, by_det * xx);
    }
    add(out.m2_plane, by_m2);
    add(out.intensity, sums.intensity);
    add(out.absorb, sums.absorb);
}

// The same for kLanes slices, one a lane.
struct SliceGradients {
    float mean_x[kLanes], mean_z[kLanes], cov_xx[kLanes], cov_xz[kLanes], cov_zz[kLanes], m2_plane[kLanes];
    float intensity[kLanes], absorb[kLanes];
};

inline void gather_slice(const View& view, const Slice& s, const PixelGradients& pixels, SliceGradients& out, int lane) {
    SliceGradient sum;
    const Course course = course_of(view, s);
    for (int line = s.first; line <= s.last; line += kLanes) gather_group(view, s, course, pixels, line, sum);
    out.mean_x[lane] = total(sum.mean_x), out.mean_z[lane] = total(sum.mean_z);
    out.cov_xx[lane] = total(sum.cov_xx), out.cov_xz[lane] = total(sum.cov_xz), out.cov_zz[lane] = total(sum.cov_zz);
    out.m2_plane[lane] = total(sum.m2_plane);
    out.intensity[lane] = total(sum.intensity), out.absorb[lane] = total(sum.absorb);
}

// What intensity passes back: by each coefficient, and by the mean through the direction of view.
struct HarmonicsGradient {
    Floats coefficients[kMaxShCoefficients];
    Floats mean[3];
};

inline HarmonicsGradient differentiate_harmonics(const SceneView& scene, const Harmonics& harmonics, const Direction& v,
                                                 Floats by_intensity) {
    const int degree = scene.sh_degree;
    const Floats *sh = harmonics.coefficients, x = v.x, y = v.y, z = v.z;
    const Floats value = spherical_harmonics(harmonics, degree, x, y, z), activated = activate(scene.intensity, value);
    const Mask inside = both(less_equal(splat(0.5f), value + 1.0f), less_equal(value + 1.0f, splat(0.999f)));
    const Floats slope =
        scene.intensity == Intensity::Sigmoid ? 4.0f * activated * (1.0f - activated) : keep(inside, splat(1.0f));
    const Floats by_value = by_intensity * slope;

    HarmonicsGradient out;
    Floats* c = out.coefficients;
    Floats gx{}, gy{}, gz{};
    c[0] = splat(0.28209479177387814f);
    if (degree >= 1) {
        const float k = 0.4886025119029199f;
        c[1] = -k * y, c[2] = k * z, c[3] = -k * x;
        gx = -k * sh[3], gy = -k * sh[1], gz = k * sh[2];
    }
    if (degree >= 2) {
        const float k = 1.0925484305920792f, l = 0.31539156525252005f;
        c[4] = k * x * y, c[5] = -k * y * z, c[6] = l * (2.0f * z * z - x * x - y * y);
        c[7] = -k * x * z, c[8] = 0.5f * k * (x * x - y * y);
        gx += k * (y * sh[4] - z * sh[7] + x * sh[8]) - 2.0f * l * x * sh[6];
        gy += k * (x * sh[4] - z * sh[5] - y * sh[8]) - 2.0f * l * y * sh[6];
        gz += 4.0f * l * z * sh[6] - k * (y * sh[5] + x * sh[7]);
    }
    if (degree >= 3) {
        const float a = 0.5900435899266435f, b = 2.890611442640554f, d = 0.4570457994644658f, e = 0.3731763325901154f;
        const Floats xx = x * x, yy = y * y, zz = z * z;
        c[9] = -a * y * (3.0f * xx - yy), c[10] = b * x * y * z, c[11] = -d * y * (4.0f * zz - xx - yy);
        c[12] = e * z * (2.0f * zz - 3.0f * xx - 3.0f * yy), c[13] = -d * x * (4.0f * zz - xx - yy);
        c[14] = 0.5f * b * z * (xx - yy), c[15] = -a * x * (xx - 3.0f * yy);
        gx += b * (y * z * sh[10] + x * z * sh[14]) - 6.0f * a * x * y * sh[9] - 3.0f * a * (xx - yy) * sh[15];
        gx += d * (2.0f * x * y * sh[11] - (4.0f * zz - 3.0f * xx - yy) * sh[13]) - 6.0f * e * x * z * sh[12];
        gy += b * (x * z * sh[10] - y * z * sh[14]) + 6.0f * a * x * y * sh[15] - 3.0f * a * (xx - yy) * sh[9];
        gy += d * (2.0f * x * y * sh[13] - (4.0f * zz - xx - 3.0f * yy) * sh[11]) - 6.0f * e * y * z * sh[12];
        gz += b * (x * y * sh[10] + 0.5f * (xx - yy) * sh[14]) - 8.0f * d * z * (y * sh[11] + x * sh[13]);
        gz += e * (6.0f * zz - 3.0f * xx - 3.0f * yy) * sh[12];
    }
    for (int t = 0; t < (degree + 1) * (degree + 1); ++t) c[t] *= by_value;
    const Floats along = x * gx + y * gy + z * gz;  // turning the direction does not change its length
    const Floats rate = keep(less_equal(v.inverse_length, splat(1e15f)), by_value * v.inverse_length);
    out.mean[0] = rate * (gx - x * along), out.mean[1] = rate * (gy - y * along), out.mean[2] = rate * (gz - z * along);
    return out;
}

// From kLanes slices to their Gaussians: `place` and the conditioning on the plane, backwards. In float, but with a beam:
// then its terms, with fourth powers of scales, do not fit.
template <bool thick, bool displaced>
inline void differentiate_slices(const SceneView& scene, const View& view, const Candidates& c, const SliceGradients& by,
                                 GaussianGradient* gradients, float* sh_gradients, BeamMoments& moments,
                                 ViewGradient* by_view, float* const* by_fields) {
    using Reals = std::conditional_t<thick, Doubles, Floats>;
    const auto convert = [](auto vector) { return __builtin_convertvector(vector, Reals); };
    const auto take = [&](const float* p) { return convert(load<Floats>(p)); };
    Placed<Reals> p = place<Reals, displaced>(scene, view, c);
    Spread spread;
    if constexpr (thick) spread = spread_along_elevation<displaced>(view, p);
    const Reals mean_x = take(by.mean_x), mean_z = take(by.mean_z), m2 = take(by.m2_plane);
    const Reals cov_xx = take(by.cov_xx), cov_xz = take(by.cov_xz), cov_zz = take(by.cov_zz);
    const Reals inverse = 1 / p.yy, height = p.mu[1] * inverse, tilt_x = p.xy * inverse, tilt_z = p.yz * inverse;
    Reals by_mu[3] = {mean_x, 2 * height * m2 - tilt_x * mean_x - tilt_z * mean_z, mean_z};
    const Reals by_xy = -2 * tilt_x * cov_xx - tilt_z * cov_xz - height * mean_x;
    const Reals by_yz = -2 * tilt_z * cov_zz - tilt_x * cov_xz - height * mean_z;
    const Reals by_yy = tilt_x * tilt_x * cov_xx + tilt_x * tilt_z * cov_xz + tilt_z * tilt_z * cov_zz -
                        height * height * m2 + height * (tilt_x * mean_x + tilt_z * mean_z);

    Reals by_precision{};
    if constexpr (thick) {
        by_precision = m2 * spread.variance / spread.ratio;
        const Doubles by_variance = by_yy + m2 * spread.precision / spread.ratio;
        const Doubles by_depth = 2.0 * view.beam.slope2 * by_variance * spread.offset,
                      depth = spread.offset + view.beam.focus;
        if (view.fanned)
            by_mu[0] += by_depth * p.mu[0] / depth, by_mu[2] += by_depth * p.mu[2] / depth;
        else
            by_mu[2] += by_depth;
        for (int k = 0; k < c.count; ++k) {
            const double offset = spread.offset[k];
            moments.zeroth += by_variance[k], moments.first += by_variance[k] * offset;
            moments.second += by_variance[k] * offset * offset;
        }
    }

    Lane<Reals> axes[3][3];
    for (int a = 0; a < 3; ++a)
        for (int d = 0; d < 3; ++d) axes[a][d] = static_cast<Lane<Reals>>(view.axes[a][d]);
    const auto in_scene = [&](const Reals* v, int d) { return axes[0][d] * v[0] + axes[1][d] * v[1] + axes[2][d] * v[2]; };
    Reals by_axes[3][3], by_log_scale[3];  // by_axes[d][k]: axis k along d, in the scene's axes
    Reals by_map[3][3]{}, twist[3]{};      // of displaced tissue: by F, and the torque on its spokes
    for (int k = 0; k < 3; ++k) {
        const Reals* s = p.spoke[k];
        Reals by_spoke[3] = {2 * s[0] * cov_xx + s[1] * by_xy + s[2] * cov_xz,
                             2 * s[1] * by_yy + s[0] * by_xy + s[2] * by_yz,
                             2 * s[2] * cov_zz + s[0] * cov_xz + s[1] * by_yz};
        by_log_scale[k] = by_spoke[0] * s[0] + by_spoke[1] * s[1] + by_spoke[2] * s[2];
        if constexpr (thick && displaced) {  // the precision is eT S^-1 e
            const Reals *n = spread.normal, pull = -2 * by_precision * (n[0] * s[0] + n[1] * s[1] + n[2] * s[2]);
            for (int d = 0; d < 3; ++d) by_spoke[d] += pull * n[d];
            by_log_scale[k] = by_spoke[0] * s[0] + by_spoke[1] * s[1] + by_spoke[2] * s[2];
        } else if constexpr (thick) {  // it is the sum of (spoke / scale^2)^2 along elevation
            const Reals pull = 2 * by_precision * s[1] / (p.scale[k] * p.scale[k] * p.scale[k] * p.scale[k]);
            by_spoke[1] += pull;
            by_log_scale[k] -= pull * s[1];
        }
        if constexpr (displaced) {
            const Reals by_own[3] = {in_scene(by_spoke, 0), in_scene(by_spoke, 1), in_scene(by_spoke, 2)};
            Reals own[3];  // the spoke in the scene's axes
            for (int d = 0; d < 3; ++d)
                own[d] = p.scale[k] * (p.map[d][0] * p.axes[0][k] + p.map[d][1] * p.axes[1][k] + p.map[d][2] * p.axes[2][k]);
            for (int d = 0; d < 3; ++d) {
                for (int e = 0; e < 3; ++e) by_map[d][e] += by_own[d] * p.scale[k] * p.axes[e][k];
                const int e = (d + 1) % 3, f = (d + 2) % 3;
                twist[d] += own[e] * by_own[f] - own[f] * by_own[e];
                by_axes[d][k] = p.scale[k] * (p.map[0][d] * by_own[0] + p.map[1][d] * by_own[1] + p.map[2][d] * by_own[2]);
            }
        } else {
            for (int d = 0; d < 3; ++d) by_axes[d][k] = p.scale[k] * in_scene(by_spoke, d);
        }
    }
    const Reals w = p.quat[0], x = p.quat[1], y = p.quat[2], z = p.quat[3];
    const auto& m = by_axes;
    const Reals by_quat[4] = {
        2 * (x * (m[2][1] - m[1][2]) + y * (m[0][2] - m[2][0]) + z * (m[1][0] - m[0][1])),
        2 * (w * (m[2][1] - m[1][2]) + y * (m[0][1] + m[1][0]) + z * (m[0][2] + m[2][0]) - 2 * x * (m[1][1] + m[2][2])),
        2 * (w * (m[0][2] - m[2][0]) + x * (m[0][1] + m[1][0]) + z * (m[1][2] + m[2][1]) - 2 * y * (m[0][0] + m[2][2])),
        2 * (w * (m[1][0] - m[0][1]) + x * (m[0][2] + m[2][0]) + y * (m[1][2] + m[2][1]) - 2 * z * (m[0][0] + m[1][1])),
    };
    const HarmonicsGradient harmonics =
        differentiate_harmonics(scene, load_harmonics(scene, c), direction_of(p.offset), load<Floats>(by.intensity));
    Reals by_place[3], by_mean[3];  // by the mean as the probe sees it, and in all
    for (int d = 0; d < 3; ++d) {
        by_place[d] = in_scene(by_mu, d);
        by_mean[d] = by_place[d] + convert(harmonics.mean[d]);
    }

    Floats by_rest[3] = {to_floats(by_mean[0]), to_floats(by_mean[1]), to_floats(by_mean[2])};
    if constexpr (displaced) {
        Doubles mean[3]{};
        Floats by_f[3][3];
        for (int d = 0; d < 3; ++d) {
            for (int k = 0; k < c.count; ++k) mean[d][k] = scene.gaussians[c.ids[k]].mean[d];
            for (int e = 0; e < 3; ++e) by_f[d][e] = to_floats(by_map[d][e]);
        }
        differentiate_displacement(view, c.count, mean, by_rest, by_f, by_fields);
    }

    const int terms = (scene.sh_degree + 1) * (scene.sh_degree + 1);
    for (int k = 0; k < c.count; ++k) {
        GaussianGradient& to = gradients[c.ids[k]];
        for (int d = 0; d < 3; ++d) to.mean[d] += by_rest[d][k], to.log_scale[d] += float(by_log_scale[d][k]);
        for (int d = 0; d < 4; ++d) to.quat[d] += float(by_quat[d][k]);
        to.absorb += scene.weighted ? -2.0f * by.m2_plane[k] : by.absorb[k];
        float* sh = sh_gradients + c.ids[k] * terms;
        for (int t = 0; t < terms; ++t) sh[t] += harmonics.coefficients[t][k];
    }
    if (by_view == nullptr) return;
    // To move the probe is to move all Gaussians the other way; but a turn about its own origin changes no intensity, which
    // depends on the direction of view in the scene's axes.
    for (int d = 0; d < 3; ++d) {
        const int e = (d + 1) % 3, f = (d + 2) % 3;
        const Reals spin = w * by_quat[d + 1] - p.quat[d + 1] * by_quat[0] + p.quat[e + 1] * by_quat[f + 1] -
                           p.quat[f + 1] * by_quat[e + 1];
        const Reals torque = displaced ? twist[d] : spin / 2;
        const Reals turn = p.offset[e] * by_place[f] - p.offset[f] * by_place[e] + torque;
        for (int k = 0; k < c.count; ++k) by_view->shift[d] -= by_mean[d][k], by_view->turn[d] -= turn[k];
    }
}

void gather(const SceneView& scene, const View& view, const Slice* slices, int64_t count, const PixelGradients& pixels,
            GaussianGradient* gradients, float* sh_gradients, BeamMoments& moments, ViewGradient* by_view,
            float* const* by_fields) {
    const SmallestAreZero flushed;
    const auto differentiate = [&](auto thick, const Candidates& c, const SliceGradients& by) {
        (view.field_count
             ? differentiate_slices<thick, true>
             : differentiate_slices<thick, false>)(scene, view, c, by, gradients, sh_gradients, moments, by_view, by_fields);
    };
    for (int64_t first = 0; first < count; first += kLanes) {
        Candidates c;
        SliceGradients by;
        if (count - first < kLanes) by = {};  // the last lanes are of no slice
        for (; c.count < kLanes && first + c.count < count; ++c.count) {
            const Slice& s = slices[first + c.count];
            gather_slice(view, s, pixels, by, c.count);
            c.ids[c.count] = s.gaussian;
        }
        if (view.beam.is_thick())
            differentiate(std::true_type{}, c, by);
        else
            differentiate(std::false_type{}, c, by);
    }
}

}  // namespace

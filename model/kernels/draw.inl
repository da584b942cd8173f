// From slices to pixels: S, sum of I*w and T on a strip of scan lines (docs/physics.md §3, §5.3).
//
// kLanes neighbouring scan lines form a vector and the loop runs down the rows. In depth steps of du standard deviations the
// echo weight is a Gaussian progression, w(k+1) = w(k) r(k) and r(k+1) = r(k) q, which costs two products a row instead of
// an exponential; it is restarted every few rows so that rounding stays under 1e-4 of w. The absorption is exp(-m2/2) sigma
// G(u) with one polynomial for G, or its quadrature itself where depth 0 clips the window.

#pragma once

namespace {

constexpr float kMinPsi = 0.0039292930f;  // -log(1 - 1/255): alpha reaches 1/255
constexpr float kMaxWeight = 0.999f;
constexpr float kMaxM2Attenuation = 9.0f;
constexpr float kFullG = 2.8906850f;    // G(u) for u >= 3
constexpr float kNegligible = 24.0f;    // w < 7e-6 beyond m2 + u2: dozens of such tails on a pixel still do not show
constexpr float kEarlySigma = 1.8f;     // an opaque Gaussian wider than this, cm, absorbs 1/255 above the rows where w does
constexpr float kMinVariance = 1e-32f;  // cm2; thinner ones touch no row

constexpr float kNode = 0.7745966692f;  // Gauss-Legendre: nodes 0, +-sqrt(0.6)
constexpr int kRestartRows = 32;

// G of docs/physics.md §3 for unclipped windows, constant beyond the ends of its fit.
#if defined(__AVX512F__)
// Parabolas on steps of 0.2 from -3.4 to 3 (the kink at 0 lies between two), looked up within registers: within 3e-5.
inline Floats absorption_profile(Floats u) {
    const Floats at = minimum(maximum(u, splat(-3.3999f)), splat(2.9999f));
    const __m512i step = (__m512i)((at * 5.0f + 16.5f) + 12582912.0f);  // 1.5 * 2^23: the step is in the low bits
    const auto coefficient = [&](int power) {
        const float* row = kProfile.parabola[power];
        return (Floats)_mm512_permutex2var_ps(_mm512_loadu_ps(row), step, _mm512_loadu_ps(row + 16));
    };
    return (coefficient(2) * at + coefficient(1)) * at + coefficient(0);
}
#else
// A minimax polynomial in u, within 3.2e-4.
inline Floats absorption_profile(Floats u) {
    const Floats v = (minimum(maximum(u, splat(-3.34f)), splat(3.0f)) + 0.17f) * (1.0f / 3.17f);
    Floats p = splat(-1.17912165f);
    p = p * v - 1.08363338f;
    p = p * v + 4.49129112f;
    p = p * v + 4.48426945f;
    p = p * v - 6.86307471f;
    p = p * v - 8.09939924f;
    p = p * v + 5.18377769f;
    p = p * v + 8.18838f;
    p = p * v - 2.00312422f;
    p = p * v - 5.11385445f;
    p = p * v + 0.737662447f;
    p = p * v + 3.06877651f;
    return p * v + 1.0784183f;
}
#endif

// G where depth 0, at u = zero, clips the window (or not): the three-point Gauss-Legendre rule of §3.
inline Floats clipped_profile(Floats u, Floats zero) {
    const Floats centre = minimum(maximum(zero, Floats{}), u);
    const Floats low = maximum(centre - 3.0f, zero), high = minimum(centre + 3.0f, u);
    const Floats half = 0.5f * (high - low), middle = 0.5f * (high + low);
    const Floats before = middle - kNode * half, after = middle + kNode * half;
    const Floats sum = (8.0f / 9.0f) * exponential(-0.5f * middle * middle) +
                       (5.0f / 9.0f) * (exponential(-0.5f * before * before) + exponential(-0.5f * after * after));
    const Floats depth = u - zero, point = 0.5f * (u + zero);
    const Mask degenerate = either(less_equal(depth * depth, splat(1e-8f)), less_equal(high, low));
    return select(degenerate, depth * exponential(-0.5f * point * point), half * sum);
}

enum class Profile {
    Thin,     // psi small: alpha by a short series
    Thick,    // any psi
    Clipped,  // the window may reach depth 0
};

// kLanes scan lines across one slice; depth is u, in standard deviations from s*.
struct Group {
    Floats u;   // at row `base`
    Floats du;  // per row
    Floats m2;
    Floats window2;         // u2 up to here has w >= 1/255
    Floats sigma;           // along the line, cm
    Floats peak;            // exp(-m2/2) sigma where m2 <= 9, else 0: psi = peak * G(u)
    Floats zero;            // u at depth 0
    Floats across, spread;  // distance of the slice's mean from the line, 1 / its variance in that direction
    Mask touched;           // the line comes close enough for w to reach 1/255
    Mask opaque;            // alpha reaches 1/255 below the Gaussian
    int base;
};

template <Profile profile>
inline void draw_rows(const Group& g, const Slice& s, const Strip& strip, int column, int top, int end) {
    const float fastest = largest(keep(g.touched, g.du));
    const int period = fastest * kRestartRows > 8.0f ? (fastest < 8.0f ? int(8.0f / fastest) : 1) : kRestartRows;
    const Floats q = exponential(-g.du * g.du);
    const Floats intensity = splat(s.intensity), absorb = splat(s.absorb);
    for (int block = top; block < end; block += period) {
        Floats steps = splat(float(block - g.base));
        Floats u = g.u + steps * g.du;
        Floats w = exponential(-0.5f * (g.m2 + u * u));
        Floats r = exponential(-g.du * (u + 0.5f * g.du));
        const int stop = block + period < end ? block + period : end;
        for (int i = block; i < stop; ++i) {
            const Floats psi = g.peak * (profile == Profile::Clipped ? clipped_profile(u, g.zero) : absorption_profile(u));
            const Mask counted = either(less_equal(u * u, g.window2), less_equal(splat(kMinPsi), psi));
            Floats alpha;
            if (profile == Profile::Thin)
                alpha = psi * (1.0f - psi * (0.5f - psi * (1.0f / 6.0f)));
            else
                alpha = minimum(1.0f - exponential(-psi), splat(kMaxWeight));
            const Floats weight = keep(counted, minimum(w, splat(kMaxWeight)));
            const int64_t at = int64_t(i) * strip.stride + column;
            store(strip.weight + at, load<Floats>(strip.weight + at) + weight);
            store(strip.intensity + at, load<Floats>(strip.intensity + at) + intensity * weight);
            store(strip.local + at, load<Floats>(strip.local + at) * (1.0f - absorb * keep(counted, alpha)));
            w *= r;
            r *= q;
            steps += 1.0f;
            u = g.u + steps * g.du;  // not u += du: a window's edge must not drift
        }
    }
}

inline Group cross(const View& view, const Slice& s, int line) {
    const Doubles dx = load<Doubles>(view.dir_x + line), dz = load<Doubles>(view.dir_z + line);
    const Doubles x = s.mean_x - load<Doubles>(view.line_x + line);
    const Doubles across = dx * s.mean_z - dz * x;
    const Doubles spread = 1.0 / (dx * dx * s.cov_zz - 2.0 * dx * dz * s.cov_xz + dz * dz * s.cov_xx);
    const Doubles star = spread * (dx * (s.cov_zz * x - s.cov_xz * s.mean_z) + dz * (s.cov_xx * s.mean_z - s.cov_xz * x));
    const Floats variance = to_floats((s.cov_xx * s.cov_zz - s.cov_xz * s.cov_xz) * spread);
    const double bound = view.height - 1;
    const double base = (s.depth - view.near) / view.row_step;  // near the centre: u stays exact where it matters

    Group g;
    g.base = static_cast<int>(base > 0 ? (base < bound ? base : bound) : 0);
    g.m2 = s.m2_plane + to_floats(across * across * spread);
    g.across = to_floats(across), g.spread = to_floats(spread);
    g.window2 = float(kMaxM2) - g.m2;
    g.touched = both(less_equal(Floats{}, g.window2), less_equal(splat(kMinVariance), variance));
    g.sigma = square_root(maximum(variance, splat(kMinVariance)));
    const Floats inverse_sigma = 1.0f / g.sigma;
    g.u = to_floats((view.near + view.row_step * (g.base + 0.5)) - star) * inverse_sigma;
    g.du = float(view.row_step) * inverse_sigma;
    g.zero = -to_floats(star) * inverse_sigma;
    const Mask absorbs = both(g.touched, less_equal(g.m2, splat(kMaxM2Attenuation)));
    g.peak = keep(absorbs, exponential(-0.5f * g.m2) * g.sigma);
    g.opaque = less_equal(splat(kMinPsi), g.peak * kFullG);
    return g;
}

// The rows of a group where its slice counts, and how its absorption is to be computed there.
struct Extent {
    int top, end;
    Profile profile;
    Floats whole;  // u from which on the Gaussian is fully crossed
};

inline Extent extent_of(const View& view, const Group& g) {
    const Floats window = square_root(maximum(g.window2, Floats{}));
    const Floats whole = 3.0f + maximum(g.zero, Floats{});  // the window ends here even where the mean lies before the face
    const Floats tail = maximum(whole, square_root(maximum(kNegligible - g.m2, Floats{})));
    const Floats first_row = (-window - g.u) / g.du, last_row = (select(g.opaque, tail, window) - g.u) / g.du;
    const float top_row = smallest(select(g.touched, first_row, splat(1e9f))) + float(g.base);
    const float end_row = largest(select(g.touched, last_row, splat(-1e9f))) + float(g.base);
    const bool early = largest(keep(g.opaque, g.sigma)) > kEarlySigma;
    const float bound = float(view.height - 1);
    const float nearest = largest(select(g.touched, g.zero, splat(-1e9f)));
    const bool thick = largest(g.peak) * kFullG > 0.2f;
    return {early || !(top_row > 0.0f) ? 0
            : top_row > bound          ? view.height
                                       : static_cast<int>(top_row),
            !(end_row >= 0.0f) ? 0
            : end_row > bound  ? view.height
                               : static_cast<int>(end_row) + 1,
            nearest > -6.4f || early ? Profile::Clipped
            : thick                  ? Profile::Thick
                                     : Profile::Thin,
            whole};
}

inline void draw_group(const View& view, const Slice& s, const Strip& strip, int column) {
    const Group g = cross(view, s, strip.first + column);
    if (!any(g.touched)) return;
    const Extent extent = extent_of(view, g);
    const int top = extent.top, end = extent.end;
    if (top < end) switch (extent.profile) {
            case Profile::Thin:
                draw_rows<Profile::Thin>(g, s, strip, column, top, end);
                break;
            case Profile::Thick:
                draw_rows<Profile::Thick>(g, s, strip, column, top, end);
                break;
            case Profile::Clipped:
                draw_rows<Profile::Clipped>(g, s, strip, column, top, end);
                break;
        }
    if (end < view.height && any(g.opaque)) {
        const Floats below = g.peak * clipped_profile(extent.whole, g.zero);
        const Floats alpha = minimum(1.0f - exponential(-below), splat(kMaxWeight));
        const Mask passes = less_equal(splat(kMinPsi), below);
        const int64_t at = int64_t(end) * strip.stride + column;
        store(strip.below + at, load<Floats>(strip.below + at) * (1.0f - s.absorb * keep(passes, alpha)));
    }
}

void draw(const View& view, const Slice* slices, int64_t count, const Strip& strip) {
    for (int64_t i = 0; i < count; ++i) {
        const Slice& s = slices[i];
        int from = s.first - strip.first, to = s.last - strip.first;
        if (to < 0 || from >= strip.lines) continue;
        from = from > 0 ? from : 0;
        to = to < strip.lines ? to : strip.lines - 1;
        for (int column = from; column <= to; column += kLanes) draw_group(view, s, strip, column);
    }
}

// B = E T, E = (1 - exp(-S)) sum(I w) / (S + 1e-8), and the cumulative product of the steps down each scan line.
void finish(const View& view, const Strip& strip, const FramePointers& frame, const SavedPlanes& saved) {
    const auto put = [&](float* plane, int row, int column, Floats value) {
        if (plane == nullptr) return;
        float* to = plane + int64_t(row) * view.lines + strip.first + column;
        if (column + kLanes <= strip.lines) {
            store(to, value);
        } else {
            float lanes[kLanes];
            store(lanes, value);
            for (int k = 0; column + k < strip.lines; ++k) to[k] = lanes[k];
        }
    };
    for (int column = 0; column < strip.lines; column += kLanes) {
        Floats passed = splat(1.0f);
        for (int row = 0; row < view.height; ++row) {
            const int64_t at = int64_t(row) * strip.stride + column;
            passed *= load<Floats>(strip.below + at);
            const Floats transmittance = load<Floats>(strip.local + at) * passed;
            const Floats sum = load<Floats>(strip.weight + at);
            const Floats series = sum * (1.0f - 0.5f * sum);  // 1 - exp loses digits where S is small
            const Floats coverage = select(less_equal(sum, splat(1e-3f)), series, 1.0f - exponential(-sum));
            const Floats echo = coverage * load<Floats>(strip.intensity + at) / (sum + 1e-8f);
            put(frame.bmode, row, column, echo * transmittance);
            put(frame.echo, row, column, echo);
            put(frame.transmittance, row, column, transmittance);
            put(frame.coverage, row, column, coverage);
            put(frame.weight_sum, row, column, sum);
            if (saved.weight == nullptr) continue;
            const int64_t kept = int64_t(row) * saved.stride + strip.first + column;
            store(saved.weight + kept, sum);
            store(saved.intensity + kept, load<Floats>(strip.intensity + at));
            store(saved.transmittance + kept, transmittance);
        }
    }
}

}  // namespace

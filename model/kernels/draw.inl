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
constexpr float kPeakedM2 = 0.00201f;   // w stays under kMaxWeight beyond
constexpr float kMinVariance = 1e-32f;  // cm2; thinner ones touch no row

constexpr float kNode = 0.7745966692f;  // Gauss-Legendre: nodes 0, +-sqrt(0.6)
constexpr int kRestartRows = 32;

// G of docs/physics.md §3 for unclipped windows, or its slope, looked up: constant beyond the ends of the table.
#if defined(__AVX512F__)
inline Floats looked_up(const FineProfile& table, Floats u) {
    const Floats v = limited(u - FineProfile::kMiddle, splat(3.1999f));
    const __m512i piece = (__m512i)_mm512_fmadd_round_ps((__m512)v, _mm512_set1_ps(5.0f), _mm512_set1_ps(12582912.0f),
                                                         _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC);  // in its low bits
    const auto coefficient = [&](int power) {
        const float* row = table.term[power];
        return (Floats)_mm512_permutex2var_ps(_mm512_load_ps(row), piece, _mm512_load_ps(row + 16));
    };
    return (coefficient(2) * v + coefficient(1)) * v + coefficient(0);
}

inline Floats absorption_profile(Floats u) { return looked_up(kFineProfile, u); }  // within 3e-5
inline Floats profile_slope(Floats u) { return keep(less_equal(u, splat(3.0f)), looked_up(kFineProfileSlope, u)); }
#else
inline Floats looked_up(const CoarseProfile& table, Floats u) {
    constexpr int kPieces = CoarseProfile::kPieces;
    const Floats v = minimum(maximum(u, splat(-3.3999f)), splat(3.0f));
#if defined(__wasm_simd128__)
    // Rounding down by adding 1.5 * 2^23 leaves the piece in the low bits, of which four bytes each find a coefficient.
    const Ints piece = (Ints)((v * (1.0f / CoarseProfile::kWidth) - 0.5f) + 12582912.0f) & (kPieces - 1);
    const Ints low = piece * 0x04040404 + 0x03020100;
    const v128_t high = wasm_i8x16_sub((v128_t)low, wasm_i8x16_splat(16));
#else
    const Ints piece = __builtin_convertvector(v * (1.0f / CoarseProfile::kWidth) + float(kPieces), Ints);  // mod kPieces
#endif
    const auto coefficient = [&](int power) {
        const float* row = table.term[power];
#if defined(__AVX2__)
        return (Floats)_mm256_permutevar8x32_ps(_mm256_load_ps(row), (__m256i)piece);
#elif defined(__wasm_simd128__)
        return (Floats)wasm_v128_or(wasm_i8x16_swizzle(wasm_v128_load(row), (v128_t)low),
                                    wasm_i8x16_swizzle(wasm_v128_load(row + kLanes), high));
#else
        Floats found;
        for (int k = 0; k < kLanes; ++k) found[k] = row[piece[k] & (kPieces - 1)];
        return found;
#endif
    };
    return (((coefficient(4) * v + coefficient(3)) * v + coefficient(2)) * v + coefficient(1)) * v + coefficient(0);
}

inline Floats absorption_profile(Floats u) { return looked_up(kCoarseProfile, u); }  // within 3e-5
inline Floats profile_slope(Floats u) { return keep(less_equal(u, splat(3.0f)), looked_up(kCoarseProfileSlope, u)); }
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
    None,     // nothing absorbs
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
    Floats first, last;     // u between which w or alpha reaches 1/255, unless absorption begins after w has ended
    Mask touched;           // the line comes close enough for w to reach 1/255
    Mask opaque;            // alpha reaches 1/255 below the Gaussian
    int base;
};

// Rows after which the progression starts anew.
inline int restart_period(const Group& g) {
    if (!any(both(g.touched, less_equal(splat(8.0f / kRestartRows), g.du)))) return kRestartRows;
    const float fastest = largest(keep(g.touched, g.du));
    return fastest < 8.0f ? int(8.0f / fastest) : 1;
}

// What passes a pixel of psi: 1 - absorb alpha.
template <Profile profile>
inline Floats passing(Floats psi, Floats absorb) {
    if (profile != Profile::Thin) return 1.0f - absorb * minimum(1.0f - exponential(-psi), splat(kMaxWeight));
    return 1.0f - psi * (absorb - psi * (absorb * (1.0f / 2.0f) - psi * (absorb * (1.0f / 6.0f))));
}

// `simple`: what counts of a line is one stretch of u, g.first to g.last, and nowhere does w reach its limit.
template <Profile profile, bool simple>
inline void draw_rows(const Group& group, const Slice& s, const Strip& strip, int column, int top, int end) {
    const Group g = group;  // its own: what is stored below could be anything to the compiler
    const int period = restart_period(g);
    const Floats q = exponential(-g.du * g.du);
    const Floats intensity = splat(s.intensity), absorb = splat(s.absorb);
    const int64_t stride = strip.stride;
    float* __restrict weights = strip.weight + column;
    float* __restrict intensities = strip.intensity + column;
    float* __restrict local = strip.local + column;
    for (int block = top; block < end; block += period) {
        Floats steps = splat(float(block - g.base));
        Floats u = g.u + steps * g.du;
        Floats w = exponential(-0.5f * (g.m2 + u * u));
        Floats r = exponential(-g.du * (u + 0.5f * g.du));
        const int stop = block + period < end ? block + period : end;
        for (int i = block; i < stop; ++i) {
            Floats shape{};
            if (profile != Profile::None)
                shape = profile == Profile::Clipped ? clipped_profile(u, g.zero) : absorption_profile(u);
            const Mask near = less_equal(u * u, g.window2);
            const Mask counted = simple                     ? within(g.first, u, g.last)
                                 : profile == Profile::None ? near
                                                            : either(near, less_equal(splat(kMinPsi), g.peak * shape));
            const Floats weight = keep(counted, simple ? w : minimum(w, splat(kMaxWeight)));
            const int64_t at = i * stride;
            store(weights + at, load<Floats>(weights + at) + weight);
            store(intensities + at, load<Floats>(intensities + at) + intensity * weight);
            if (profile != Profile::None)
                store(local + at, load<Floats>(local + at) * passing<profile>(keep_product(counted, g.peak, shape), absorb));
            w *= r;
            r *= q;
            steps += 1.0f;
            u = g.u + steps * g.du;  // not u += du: a window's edge must not drift
        }
    }
}

// What a slice is to all lines of a view.
struct Course {
    int base;           // row next to the slice's centre: u stays exact where it matters
    double base_depth;  // of that row, cm
    // Where the lines are parallel, so that these are the same to all:
    float spread, slant;    // 1 / the variance across lines, 1/cm2; cm that s* moves for each cm from the mean
    float variance, sigma;  // along a line, cm2 and cm
};

inline Course course_of(const View& view, const Slice& s) {
    const double bound = view.height - 1, base = (s.depth - view.near) / view.row_step;
    Course c{};
    c.base = static_cast<int>(base > 0 ? (base < bound ? base : bound) : 0);
    c.base_depth = view.near + view.row_step * (c.base + 0.5);
    if (view.fanned) return c;
    const double spread = 1.0 / s.cov_xx;
    c.spread = static_cast<float>(spread), c.slant = static_cast<float>(s.cov_xz * spread);
    c.variance = static_cast<float>((s.cov_xx * s.cov_zz - s.cov_xz * s.cov_xz) * spread);
    c.sigma = __builtin_sqrtf(c.variance > kMinVariance ? c.variance : kMinVariance);
    return c;
}

inline Group cross(const View& view, const Slice& s, const Course& course, int line) {
    Group g;
    g.base = course.base;
    if (view.fanned) {
        const Doubles dx = load<Doubles>(view.dir_x + line), dz = load<Doubles>(view.dir_z + line);
        const Doubles across = dx * s.mean_z - dz * s.mean_x;  // lines start at the apex, the origin
        const Doubles spread = 1.0 / (dx * dx * s.cov_zz - 2.0 * dx * dz * s.cov_xz + dz * dz * s.cov_xx);
        const Doubles star =
            spread * (dx * (s.cov_zz * s.mean_x - s.cov_xz * s.mean_z) + dz * (s.cov_xx * s.mean_z - s.cov_xz * s.mean_x));
        const Floats variance = to_floats((s.cov_xx * s.cov_zz - s.cov_xz * s.cov_xz) * spread);
        g.across = to_floats(across), g.spread = to_floats(spread);
        g.m2 = s.m2_plane + to_floats(across * across * spread);
        g.touched = less_equal(splat(kMinVariance), variance);
        g.sigma = square_root(maximum(variance, splat(kMinVariance)));
        const Floats inverse_sigma = 1.0f / g.sigma;
        g.u = to_floats(course.base_depth - star) * inverse_sigma;
        g.du = float(view.row_step) * inverse_sigma;
        g.zero = -to_floats(star) * inverse_sigma;
    } else {
        // Distances from the mean are short: float holds them as well as double does.
        const Floats x = float(s.mean_x - view.line_x[line]) - load<Floats>(view.spacing);
        const Floats slanted = course.slant * x;
        const float inverse_sigma = 1.0f / course.sigma;
        g.across = -x, g.spread = splat(course.spread);
        g.m2 = s.m2_plane + x * x * course.spread;
        g.touched = less_equal(splat(kMinVariance), splat(course.variance));
        g.sigma = splat(course.sigma);
        g.u = (float(course.base_depth - s.mean_z) + slanted) * inverse_sigma;
        g.du = splat(float(view.row_step) * inverse_sigma);
        g.zero = (slanted - float(s.mean_z)) * inverse_sigma;
    }
    g.window2 = float(kMaxM2) - g.m2;
    g.touched = both(g.touched, less_equal(Floats{}, g.window2));
    const Mask absorbs = both(g.touched, less_equal(g.m2, splat(kMaxM2Attenuation)));
    g.peak = view.absorbs ? keep(absorbs, exponential(-0.5f * g.m2) * g.sigma) : Floats{};
    g.opaque = less_equal(splat(kMinPsi), g.peak * kFullG);
    const Floats window = square_root(maximum(g.window2, Floats{}));
    g.first = select(g.touched, -window, splat(1e9f));
    g.last = select(g.opaque, splat(1e9f), window);
    return g;
}

// The rows of a group where its slice counts, and how its absorption is to be computed there.
struct Extent {
    int top, end;
    int clear;     // from this row on no window reaches depth 0, top to end
    bool clipped;  // there is no such row
    bool thick;    // psi is not small
    bool simple;   // see draw_rows
    Floats whole;  // u from which on the Gaussian is fully crossed
};

inline Extent extent_of(const View& view, const Group& g) {
    const auto any_touched = [&g](Mask m) { return any(both(g.touched, m)); };
    const Floats window = -g.first, none = splat(-1e9f);
    const Floats whole = 3.0f + maximum(g.zero, Floats{});  // the window ends here even where the mean lies before the face
    Floats last = window;
    if (any(g.opaque)) {
        const Floats tail = maximum(whole, square_root(maximum(kNegligible - g.m2, Floats{})));
        last = select(g.opaque, tail, window);
    }
    const Floats rows = g.sigma * float(1.0 / view.row_step);  // of a standard deviation
    const float top_row = -largest(select(g.touched, (g.u - g.first) * rows, none)) + float(g.base);
    const float end_row = largest(select(g.touched, (last - g.u) * rows, none)) + float(g.base);
    const float bound = float(view.height - 1);
    const bool early = any(both(g.opaque, less_equal(splat(kEarlySigma), g.sigma)));
    const bool clipped = early || any_touched(less_equal(splat(-3.0f), g.zero));
    const bool thick = any(less_equal(splat(0.2f / kFullG), g.peak));
    // Absorption may begin only after w has ended; and w reaches its limit only where m2 is near 0.
    const bool late = any(both(g.opaque, less_equal(g.peak * absorption_profile(window), splat(kMinPsi))));
    const bool high = any_touched(less_equal(g.m2, splat(kPeakedM2)));
    const int top = early || !(top_row > 0.0f) ? 0 : top_row > bound ? view.height : static_cast<int>(top_row);
    const int end = !(end_row >= 0.0f) ? 0 : end_row > bound ? view.height : static_cast<int>(end_row) + 1;
    int clear = clipped ? end : top;
    if (!clipped && any_touched(less_equal(splat(-6.4f), g.zero))) {  // windows reach 3 standard deviations up
        const float widest = largest(keep(g.touched, g.sigma));
        const float row = (3.0f * widest - float(view.near)) * float(1.0 / view.row_step) + 0.5f;
        clear = !(row > float(top)) ? top : row > float(end) ? end : static_cast<int>(row);
    }
    return {top, end, clear, clipped, thick, !late && !high, whole};
}

inline void draw_group(const View& view, const Slice& s, const Course& course, const Strip& strip, int column) {
    const Group g = cross(view, s, course, strip.first + column);
    if (!any(g.touched)) return;
    const Extent extent = extent_of(view, g);
    const int top = extent.top, clear = extent.clear, end = extent.end;
    if (!view.absorbs) {
        if (top < end)
            (extent.simple ? draw_rows<Profile::None, true> : draw_rows<Profile::None, false>)(g, s, strip, column, top,
                                                                                               end);
        return;
    }
    if (top < clear) draw_rows<Profile::Clipped, false>(g, s, strip, column, top, clear);
    if (clear < end) {
        if (extent.thick)
            (extent.simple ? draw_rows<Profile::Thick, true> : draw_rows<Profile::Thick, false>)(g, s, strip, column, clear,
                                                                                                 end);
        else
            (extent.simple ? draw_rows<Profile::Thin, true> : draw_rows<Profile::Thin, false>)(g, s, strip, column, clear,
                                                                                               end);
    }
    if (end < view.height && any(g.opaque)) {
        const Floats below = g.peak * (extent.clipped ? clipped_profile(extent.whole, g.zero) : splat(kFullG));
        const Floats alpha = minimum(1.0f - exponential(-below), splat(kMaxWeight));
        const Mask passes = less_equal(splat(kMinPsi), below);
        const int64_t at = int64_t(end) * strip.stride + column;
        store(strip.below + at, load<Floats>(strip.below + at) * (1.0f - s.absorb * keep(passes, alpha)));
    }
}

// Passes each slice that a strip of lines sees to `act`, with the columns of the strip at which its vectors begin.
template <typename Act>
inline void each_slice(const View& view, const Slice* slices, int64_t count, int first, int lines, const Act& act) {
    for (int64_t i = 0; i < count; ++i) {
        const Slice& s = slices[i];
        int from = s.first - first, to = s.last - first;
        if (to < 0 || from >= lines) continue;
        from = from > 0 ? from : 0;
        to = to < lines ? to : lines - 1;
        // Aligned where that takes no more vectors; lines all the way round would meet a slice from behind.
        const int before = from % kLanes;
        if (!view.wrap && (to - from + before) / kLanes == (to - from) / kLanes) from -= before;
        act(s, from, to);
    }
}

void draw(const View& view, const Slice* slices, int64_t count, const Strip& strip) {
    const SmallestAreZero flushed;
    each_slice(view, slices, count, strip.first, strip.lines, [&](const Slice& s, int from, int to) {
        const Course course = course_of(view, s);
        for (int column = from; column <= to; column += kLanes) draw_group(view, s, course, strip, column);
    });
}

void count_work(const View& view, const Slice* slices, int64_t count, int first, int lines, Work& work) {
    each_slice(view, slices, count, first, lines, [&](const Slice& s, int from, int to) {
        const Course course = course_of(view, s);
        ++work.slices;
        for (int column = from; column <= to; column += kLanes) {
            const Group g = cross(view, s, course, first + column);
            if (!any(g.touched)) continue;
            const Extent extent = extent_of(view, g);
            const int64_t rows = extent.top < extent.end ? extent.end - extent.top : 0;
            ++work.groups, work.rows += rows, work.lanes += rows * how_many(g.touched);
        }
    });
}

// B = E T, E = (1 - exp(-S)) sum(I w) / (S + 1e-8), and the cumulative product of the steps down each scan line.
void finish(const View& view, const Strip& strip, const Outputs& frame, const SavedPlanes& saved) {
    const auto put = [&](auto* plane, int row, int column, auto values) {
        if (plane == nullptr) return;
        auto* to = plane + int64_t(row) * view.lines + strip.first + column;
        if (column + kLanes <= strip.lines) {
            store(to, values);
        } else {
            Lane<decltype(values)> lanes[kLanes];
            store(lanes, values);
            for (int k = 0; column + k < strip.lines; ++k) to[k] = lanes[k];
        }
    };
    int64_t supported = 0;
    for (int column = 0; column < strip.lines; column += kLanes) {
        Floats passed = splat(1.0f), least = splat(frame.least_coverage);
        for (int k = strip.lines - column; k < kLanes; ++k) least[k] = __builtin_inff();
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
            put(frame.intensity_sum, row, column, load<Floats>(strip.intensity + at));
            if (frame.grey != nullptr)
                put(frame.grey, row, column, to_bytes(minimum(echo * transmittance, splat(1.0f)) * 255.0f));
            if (frame.supported != nullptr) supported += how_many(less_equal(least, coverage));
            if (saved.weight == nullptr) continue;
            const int64_t kept = int64_t(row) * saved.stride + strip.first + column;
            store(saved.weight + kept, sum);
            store(saved.intensity + kept, load<Floats>(strip.intensity + at));
            store(saved.transmittance + kept, transmittance);
        }
    }
    if (frame.supported != nullptr) __atomic_fetch_add(frame.supported, supported, __ATOMIC_RELAXED);
}

}  // namespace

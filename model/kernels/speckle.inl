// Speckle of one frame (docs/physics.md §9; the definition is ultragray.rendering.speckle). A row of samples is the sum of
// the scatterers in three planes across the slice, each from a hash of the cell that the sample lies in; samples are
// weighted by the point-spread function along depth, then across scan lines.
#pragma once

namespace {

typedef uint32_t Words __attribute__((vector_size(kLanes * sizeof(uint32_t))));

// A hash: 32 bits that follow from all of `x` (lowbias32 of C. Wellons).
inline Words scattered(Words x) {
    x = (x ^ (x >> 16)) * 0x7feb352du;
    x = (x ^ (x >> 15)) * 0x846ca68bu;
    return x ^ (x >> 16);
}

// A byte of each word.
inline Ints byte_of(Words bits, int byte) { return (Ints)(bits >> (8 * byte) & 255u); }

// log2 of positive numbers, to 1e-5.
inline Floats fast_log2(Floats x) {
    const Words bits = (Words)x;
    const Floats exponent = __builtin_convertvector((Ints)(bits >> 23), Floats) - 127.0f;
    const Floats m = (Floats)((bits & 0x007fffffu) | 0x3f800000u);
    // (log2 m) / (m - 1) on [1, 2), by least squares at Chebyshev's points.
    const Floats p = ((((((0.0204903461f) * m - 0.219008326f) * m + 1.00327497f) * m - 2.57207132f) * m + 4.05699813f) * m -
                      4.15994537f) *
                         m +
                     3.31295482f;
    return exponent + p * (m - 1.0f);
}

// The four bytes of what scatters in the cells of samples in one of the three planes.
inline Words scatterer(const SpeckleGrid& grid, const SpeckleView& view, const Words (&place)[3], int plane) {
    const uint32_t p = uint32_t(plane);
    const Words x = (place[0] + p * view.beside[0]) & 0xffff0000u, y = (place[1] + p * view.beside[1]) >> 16,
                z = (place[2] + p * view.beside[2]) >> 16;
    return scattered(((x | y) ^ z * 0x9e3779b1u) + grid.seed);
}

// The real and imaginary parts of both looks at all columns of a row of samples: `out` is [4, stride].
inline void sample_row(const SpeckleGrid& grid, const SpeckleView& view, int row, int stride, float* out) {
    const int columns = grid.columns;
    const float middle = grid.plane_weights[2 * row], beside = grid.plane_weights[2 * row + 1];
    const float along = beside * view.plane_cosine, across = beside * view.plane_sine;
    const float mean = 127.5f * (middle + 2.0f * along);  // of the bytes
    for (int c = 0; c < columns; c += kLanes) {
        Words place[3];
        for (int axis = 0; axis < 3; ++axis)
            place[axis] =
                load<Words>(view.starts + axis * columns + c) + uint32_t(row) * load<Words>(view.steps + axis * columns + c);
        const Words before = scatterer(grid, view, place, -1), at = scatterer(grid, view, place, 0),
                    after = scatterer(grid, view, place, 1);
        Floats parts[4], turned[4];
        for (int k = 0; k < 4; ++k) {
            const Ints first = byte_of(before, k), last = byte_of(after, k);
            parts[k] = middle * __builtin_convertvector(byte_of(at, k), Floats) +
                       along * __builtin_convertvector(first + last, Floats) - mean;
            turned[k] = across * __builtin_convertvector(last - first, Floats);
        }
        const Floats a1 = parts[0] - turned[1], b1 = parts[1] + turned[0];
        const Floats a2 = parts[2] - turned[3], b2 = parts[3] + turned[2];
        const Floats cosine = load<Floats>(view.column_phases + c), sine = load<Floats>(view.column_phases + columns + c);
        store(out + c, a1 * cosine - b1 * sine), store(out + stride + c, b1 * cosine + a1 * sine);
        store(out + 2 * stride + c, a2 * cosine - b2 * sine), store(out + 3 * stride + c, b2 * cosine + a2 * sine);
    }
}

// The first and the last weight that is not 0.
inline void find_weights(const float* weights, int count, int& first, int& last) {
    first = 0, last = count;
    while (first < last - 1 && weights[first] == 0.0f) ++first;
    while (last > first + 1 && weights[last - 1] == 0.0f) --last;
}

// Adds to B-mode as much of the speckle as its grey value says, in [0, 1]: `bends` are the strength at 0, and what is added
// to its slope at each level from 0 on.
inline Floats with_speckle(Floats grey, Floats speckle, const float* bends) {
    const Floats place = grey * float(kSpeckleLevels - 1);
    Floats strength = bends[0] + bends[1] * place;
    for (int k = 1; k < kSpeckleLevels - 1; ++k) strength += bends[k + 1] * maximum(place - float(k), Floats{});
    return minimum(maximum(grey + strength * speckle, Floats{}), splat(1.0f));
}

// Four sums of the same weights at once: real and imaginary parts of both looks. `at(t)` is where those of a tap begin.
template <class At>
inline void weigh(const float* weights, int begin, int end, int stride, At at, Floats (&sums)[4]) {
    for (Floats& sum : sums) sum = Floats{};
    for (int t = begin; t < end; ++t) {
        const float* from = at(t);
        const Floats w = splat(weights[t]);
        for (int k = 0; k < 4; ++k) sums[k] += w * load<Floats>(from + k * stride);
    }
}

// Puts speckle into rows [first, last) of a frame [H, W]; without one, `out` gets the speckle itself. `scratch` is of
// speckle_scratch(grid) floats.
void speckle(const SpeckleGrid& grid, const SpeckleView& view, int first, int last, const float* bmode, float* scratch,
             float* out) {
    const int stride = speckle_stride(grid), taps = grid.row_taps, wide = grid.column_taps, step = grid.column_step;
    const int width = grid.width;
    float* const ring = scratch;                               // the last `taps` rows of samples
    float* const blurred = ring + int64_t(taps) * 4 * stride;  // [4, stride]
    float* const values = blurred + 4 * stride;                // [step, stride]
    float* const shown = values + int64_t(step) * stride;      // [step, stride] as one row
    const float share1 = grid.first_look, share2 = 1.0f - grid.first_look;
    float bends[kSpeckleLevels];
    bends[0] = grid.strength[0];
    for (int k = 1; k < kSpeckleLevels; ++k)
        bends[k] = grid.strength[k] - grid.strength[k - 1] - (k > 1 ? grid.strength[k - 1] - grid.strength[k - 2] : 0.0f);
    int sampled = first / grid.row_step;  // rows before it are in the ring
    for (int i = first; i < last; ++i) {
        const int from = i / grid.row_step;
        for (; sampled < from + taps; ++sampled)
            sample_row(grid, view, sampled, stride, ring + int64_t(sampled % taps) * 4 * stride);
        const float* weights = grid.row_weights + int64_t(i) * taps;
        const float* rows[kSpeckleTaps];
        for (int t = 0; t < taps; ++t) rows[t] = ring + int64_t((from + t) % taps) * 4 * stride;
        int begin, end;
        Floats sums[4];
        find_weights(weights, taps, begin, end);
        for (int c = 0; c < grid.columns; c += kLanes) {
            weigh(weights, begin, end, stride, [&](int t) { return rows[t] + c; }, sums);
            for (int k = 0; k < 4; ++k) store(blurred + k * stride + c, sums[k]);
        }
        for (int phase = 0; phase < step; ++phase) {
            const float* weight = grid.column_weights + (int64_t(i) * step + phase) * wide;
            find_weights(weight, wide, begin, end);
            const int count = (width - phase + step - 1) / step;
            for (int q = 0; q < count; q += kLanes) {
                weigh(weight, begin, end, stride, [&](int t) { return blurred + q + t; }, sums);
                const Floats power =
                    share1 * (sums[0] * sums[0] + sums[1] * sums[1]) + share2 * (sums[2] * sums[2] + sums[3] * sums[3]);
                store(values + int64_t(phase) * stride + q, (fast_log2(power + grid.floor) - grid.mean) * grid.scale);
            }
        }
        const float* row = values;
        if (step > 1) {
            for (int phase = 0; phase < step; ++phase)
                for (int j = phase, q = 0; j < width; j += step, ++q) shown[j] = values[int64_t(phase) * stride + q];
            row = shown;
        }
        float* to = out + int64_t(i) * width;
        if (bmode == nullptr) {
            std::memcpy(to, row, width * sizeof(float));
            continue;
        }
        const float* grey = bmode + int64_t(i) * width;
        int j = 0;
        for (; j + kLanes <= width; j += kLanes)
            store(to + j, with_speckle(load<Floats>(grey + j), load<Floats>(row + j), bends));
        if (j == width) continue;
        float part[kLanes] = {};
        std::memcpy(part, grey + j, (width - j) * sizeof(float));
        store(part, with_speckle(load<Floats>(part), load<Floats>(row + j), bends));
        std::memcpy(to + j, part, (width - j) * sizeof(float));
    }
}

}  // namespace

// Gaussians in displaced tissue (docs/physics.md §9): where their means are, and the gradient F of the map that brings them
// there, by which each of their own axes turns and stretches: Sigma becomes F Sigma FT. Splines and F are those of kLanes
// Gaussians at once; the 64 coefficients of each, vectors of four, lie elsewhere than its neighbour's and are its own work.

#pragma once

namespace {

typedef float Quad __attribute__((vector_size(4 * sizeof(float))));

// The four cubic B-splines that are not 0 at a grid coordinate, their first and second derivatives.
struct Taps {
    Floats value[4], slope[4], bend[4];
    Ints first;
};

inline Taps taps_at(Doubles coordinate, int size) {
    const Ints found = __builtin_convertvector(coordinate, Ints);
    const Floats whole = __builtin_convertvector(found, Floats);
    const Floats cell = minimum(maximum(whole, splat(1)), splat(float(size - 3)));
    const Floats place = to_floats(coordinate - __builtin_convertvector(found, Doubles)) + (whole - cell);
    const Floats t = minimum(maximum(place, splat(0)), splat(1)), s = 1 - t;  // beyond, the field goes on as at the border
    const Mask moves = within(splat(0), place, splat(1));
    const auto inside = [&](Floats derivative) { return keep(moves, derivative); };
    return {{s * s * s * (1 / 6.0f), (t * t * (3 * t - 6) + 4) * (1 / 6.0f), (s * s * (3 * s - 6) + 4) * (1 / 6.0f),
             t * t * t * (1 / 6.0f)},
            {inside(-0.5f * s * s), inside(t * (1.5f * t - 2)), inside(-s * (1.5f * s - 2)), inside(0.5f * t * t)},
            {inside(s), inside(3 * t - 2), inside(3 * s - 2), inside(t)},
            __builtin_convertvector(cell, Ints) - 1};
}

inline Doubles coordinate_of(const double to_grid[4], const Doubles x[3]) {
    return splat_double(to_grid[0]) * x[0] + splat_double(to_grid[1]) * x[1] + splat_double(to_grid[2]) * x[2] +
           splat_double(to_grid[3]);
}

// A field at points: where its taps are, the displacement, and the gradient of the map x -> x + u(x).
struct Fielded {
    Taps taps[3];
    Floats moved[3], map[3][3];  // dx'_d / dx_e
};

inline void set_identity(Floats map[3][3]) {
    for (int d = 0; d < 3; ++d)
        for (int e = 0; e < 3; ++e) map[d][e] = splat(d == e ? 1.0f : 0.0f);
}

// Of `count` points; the other lanes hold anything. Sums over the taps along the first two axes of the grid, then over those
// along the third, which lie side by side.
inline void field_at(const Field& field, const Doubles x[3], int count, Fielded& at) {
    constexpr int parts = 4 * 4 / kLanes;  // vectors that hold four taps
    for (int a = 0; a < 3; ++a) at.taps[a] = taps_at(coordinate_of(field.to_grid[a], x), field.size[a]);
    const Taps &i = at.taps[0], &j = at.taps[1], &k = at.taps[2];
    const int64_t across = field.place(1, 0, 0), along = field.place(0, 1, 0);
    float found[4][3][kLanes]{};  // u, and its slopes by the grid coordinates
    for (int n = 0; n < count; ++n) {
        const float* from = field.at(i.first[n], j.first[n], k.first[n]);
        float sums[3][4 * 4];
        for (int part = 0; part < parts; ++part) {
            Floats sum{}, by_i{}, by_j{};
#pragma GCC unroll 1  // four planes at once have more weights than there are registers
            for (int p = 0; p < 4; ++p) {
                Floats plane{}, plane_by_j{};
                for (int q = 0; q < 4; ++q) {
                    const Floats taps = load<Floats>(from + p * across + q * along + part * kLanes);
                    plane += j.value[q][n] * taps, plane_by_j += j.slope[q][n] * taps;
                }
                sum += i.value[p][n] * plane, by_i += i.slope[p][n] * plane, by_j += i.value[p][n] * plane_by_j;
            }
            store(sums[0] + part * kLanes, sum);
            store(sums[1] + part * kLanes, by_i);
            store(sums[2] + part * kLanes, by_j);
        }
        const auto summed = [n](const Floats weights[4], const float* taps) {
            Quad sum{};
            for (int r = 0; r < 4; ++r) sum += weights[r][n] * load<Quad>(taps + 4 * r);
            return sum;
        };
        const Quad sum[4] = {summed(k.value, sums[0]), summed(k.value, sums[1]), summed(k.value, sums[2]),
                             summed(k.slope, sums[0])};
        for (int of = 0; of < 4; ++of)
            for (int d = 0; d < 3; ++d) found[of][d][n] = sum[of][d];
    }
    set_identity(at.map);
    for (int d = 0; d < 3; ++d) {
        at.moved[d] = load<Floats>(found[0][d]);
        for (int e = 0; e < 3; ++e)
            for (int a = 0; a < 3; ++a) at.map[d][e] += load<Floats>(found[1 + a][d]) * float(field.to_grid[a][e]);
    }
}

inline void multiply(const Floats a[3][3], const Floats b[3][3], Floats product[3][3]) {
    for (int d = 0; d < 3; ++d)
        for (int e = 0; e < 3; ++e) product[d][e] = a[d][0] * b[0][e] + a[d][1] * b[1][e] + a[d][2] * b[2][e];
}

inline void move(Doubles x[3], const Fielded& at) {
    for (int d = 0; d < 3; ++d) x[d] += __builtin_convertvector(at.moved[d], Doubles);
}

// Points displaced by a field, and F, which had what fields before this one do.
inline void displace_by(const Field& field, int count, Doubles x[3], Floats map[3][3]) {
    Fielded at;
    field_at(field, x, count, at);
    move(x, at);
    Floats before[3][3];
    std::memcpy(before, map, sizeof before);
    multiply(at.map, before, map);
}

// Of a field and one lane: from the gradient by u and by its map to that by its coefficients, which is added to, and by x
// through u's gradient, of which the second derivatives of the splines tell.
inline void differentiate_field(const Field& field, const Taps taps[3], int lane, const Floats by_moved[3],
                                const Floats by_map[3][3], Floats by_x[3], float* by_coefficients) {
    Quad by_u{}, by_slope[3]{}, bent[6]{};  // bent: xx, xy, xz, yy, yz, zz of the grid
    for (int d = 0; d < 3; ++d) {
        by_u[d] = by_moved[d][lane];
        for (int a = 0; a < 3; ++a)
            for (int e = 0; e < 3; ++e) by_slope[a][d] += by_map[d][e][lane] * static_cast<float>(field.to_grid[a][e]);
    }
    const Taps &i = taps[0], &j = taps[1], &k = taps[2];
    for (int p = 0; p < 4; ++p)
        for (int q = 0; q < 4; ++q) {
            const int64_t place = field.place(i.first[lane] + p, j.first[lane] + q, k.first[lane]);
            const float i_value = i.value[p][lane], i_slope = i.slope[p][lane];
            const float j_value = j.value[q][lane], j_slope = j.slope[q][lane];
            const float value = i_value * j_value, by_i = i_slope * j_value, by_j = i_value * j_slope;
            Quad line{}, sloped{}, curved{};
            for (int r = 0; r < 4; ++r) {
                const Quad tap = load<Quad>(field.coefficients + place + 4 * r);
                const float k_value = k.value[r][lane], k_slope = k.slope[r][lane];
                line += k_value * tap, sloped += k_slope * tap, curved += k.bend[r][lane] * tap;
                if (by_coefficients == nullptr) continue;
                float* to = by_coefficients + place + 4 * r;
                store(to, load<Quad>(to) + k_value * (value * by_u + by_i * by_slope[0] + by_j * by_slope[1]) +
                              k_slope * value * by_slope[2]);
            }
            bent[0] += i.bend[p][lane] * j_value * line, bent[1] += i_slope * j_slope * line;
            bent[2] += by_i * sloped, bent[3] += i_value * j.bend[q][lane] * line;
            bent[4] += by_j * sloped, bent[5] += value * curved;
        }
    const int of[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};
    for (int b = 0; b < 3; ++b) {
        const Quad products = by_slope[0] * bent[of[0][b]] + by_slope[1] * bent[of[1][b]] + by_slope[2] * bent[of[2][b]];
        const float by_grid = products[0] + products[1] + products[2];
        for (int e = 0; e < 3; ++e) by_x[e][lane] += by_grid * static_cast<float>(field.to_grid[b][e]);
    }
}

// `displace`, backwards: from the gradient by displaced means and by F to that by the means, in its place, and by the
// coefficients of each field (null: not wanted).
inline void differentiate_displacement(const View& view, int count, Doubles x[3], Floats by_mean[3],
                                       const Floats by_map[3][3], float* const* by_fields) {
    Fielded at[kMaxFields];
    Floats before[kMaxFields + 1][3][3];  // F up to each field
    set_identity(before[0]);
    for (int f = 0; f < view.field_count; ++f) {
        field_at(view.fields[f], x, count, at[f]);
        multiply(at[f].map, before[f], before[f + 1]);
        move(x, at[f]);
    }
    Floats by_after[3][3];  // by F up to and with the field
    std::memcpy(by_after, by_map, sizeof by_after);
    for (int f = view.field_count - 1; f >= 0; --f) {
        Floats by_own[3][3]{}, by_before[3][3]{}, by_x[3];
        for (int d = 0; d < 3; ++d) {
            by_x[d] = at[f].map[0][d] * by_mean[0] + at[f].map[1][d] * by_mean[1] + at[f].map[2][d] * by_mean[2];
            for (int e = 0; e < 3; ++e)
                for (int m = 0; m < 3; ++m) {
                    by_own[d][e] += by_after[d][m] * before[f][e][m];
                    by_before[d][e] += at[f].map[m][d] * by_after[m][e];
                }
        }
        for (int n = 0; n < count; ++n)
            differentiate_field(view.fields[f], at[f].taps, n, by_mean, by_own, by_x, by_fields ? by_fields[f] : nullptr);
        std::memcpy(by_mean, by_x, sizeof by_x);
        std::memcpy(by_after, by_before, sizeof by_after);
    }
}

}  // namespace

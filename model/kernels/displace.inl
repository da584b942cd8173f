// Gaussians in displaced tissue (docs/physics.md §9): where their means are, and the gradient F of the map that brings them
// there, by which each of their own axes turns and stretches: Sigma becomes F Sigma FT. A Gaussian is one lane's work: its
// 64 coefficients lie elsewhere than its neighbour's, and each is a vector of four.

#pragma once

namespace {

typedef float Quad __attribute__((vector_size(4 * sizeof(float))));

// The four cubic B-splines that are not 0 at a grid coordinate, their first and second derivatives.
struct Taps {
    float value[4], slope[4], bend[4];
    int first;
};

inline Taps taps_at(double coordinate, int size) {
    const double low = 1, high = size - 2;  // beyond, the field goes on as at the border
    const double held = coordinate < low ? low : coordinate > high ? high : coordinate;
    const bool moves = held == coordinate;
    const int whole = held < high ? static_cast<int>(held) : size - 3;
    const float t = static_cast<float>(held - whole), s = 1 - t, inside = moves ? 1.0f : 0.0f;
    return {{s * s * s / 6, (t * t * (3 * t - 6) + 4) / 6, (s * s * (3 * s - 6) + 4) / 6, t * t * t / 6},
            {-0.5f * s * s * inside, t * (1.5f * t - 2) * inside, -s * (1.5f * s - 2) * inside, 0.5f * t * t * inside},
            {s * inside, (3 * t - 2) * inside, (3 * s - 2) * inside, t * inside},
            whole - 1};
}

// A field at a point: where its taps are, the displacement, and the gradient of the map x -> x + u(x).
struct Fielded {
    Taps taps[3];
    Quad moved;
    float map[3][3];  // dx'_d / dx_e
};

inline Fielded field_at(const Field& field, const double x[3]) {
    Fielded at;
    for (int a = 0; a < 3; ++a) {
        const double* row = field.to_grid[a];
        at.taps[a] = taps_at(row[0] * x[0] + row[1] * x[1] + row[2] * x[2] + row[3], field.size[a]);
    }
    const Taps &i = at.taps[0], &j = at.taps[1], &k = at.taps[2];
    Quad moved{}, slopes[3]{};  // by the grid coordinates
    for (int p = 0; p < 4; ++p) {
        Quad plane{}, plane_by_j{}, plane_by_k{};
        for (int q = 0; q < 4; ++q) {
            const float* from = field.at(i.first + p, j.first + q, k.first);
            Quad line{}, line_by_k{};
            for (int r = 0; r < 4; ++r) {
                const Quad tap = load<Quad>(from + 4 * r);
                line += k.value[r] * tap, line_by_k += k.slope[r] * tap;
            }
            plane += j.value[q] * line, plane_by_j += j.slope[q] * line, plane_by_k += j.value[q] * line_by_k;
        }
        moved += i.value[p] * plane;
        slopes[0] += i.slope[p] * plane, slopes[1] += i.value[p] * plane_by_j, slopes[2] += i.value[p] * plane_by_k;
    }
    at.moved = moved;
    for (int d = 0; d < 3; ++d)
        for (int e = 0; e < 3; ++e) {
            at.map[d][e] = d == e ? 1.0f : 0.0f;
            for (int a = 0; a < 3; ++a) at.map[d][e] += slopes[a][d] * static_cast<float>(field.to_grid[a][e]);
        }
    return at;
}

inline void multiply(const float a[3][3], const float b[3][3], float product[3][3]) {
    for (int d = 0; d < 3; ++d)
        for (int e = 0; e < 3; ++e) product[d][e] = a[d][0] * b[0][e] + a[d][1] * b[1][e] + a[d][2] * b[2][e];
}

// A point displaced by all fields of a view, one after another, and F.
inline void displace(const View& view, double x[3], float map[3][3]) {
    for (int f = 0; f < view.field_count; ++f) {
        const Fielded at = field_at(view.fields[f], x);
        if (f == 0)
            std::memcpy(map, at.map, sizeof at.map);
        else {
            float before[3][3];
            std::memcpy(before, map, sizeof before);
            multiply(at.map, before, map);
        }
        for (int d = 0; d < 3; ++d) x[d] += at.moved[d];
    }
}

// Of a field: from the gradient by u and by its map to that by its coefficients, which is added to, and by x through u's
// gradient, of which the second derivatives of the splines tell.
inline void differentiate_field(const Field& field, const Taps taps[3], const float by_moved[3], const float by_map[3][3],
                                float by_x[3], float* by_coefficients) {
    Quad by_u{}, by_slope[3]{}, bent[6]{};  // bent: xx, xy, xz, yy, yz, zz of the grid
    for (int d = 0; d < 3; ++d) {
        by_u[d] = by_moved[d];
        for (int a = 0; a < 3; ++a)
            for (int e = 0; e < 3; ++e) by_slope[a][d] += by_map[d][e] * static_cast<float>(field.to_grid[a][e]);
    }
    const Taps &i = taps[0], &j = taps[1], &k = taps[2];
    for (int p = 0; p < 4; ++p)
        for (int q = 0; q < 4; ++q) {
            const int64_t place = field.place(i.first + p, j.first + q, k.first);
            const float value = i.value[p] * j.value[q], by_i = i.slope[p] * j.value[q], by_j = i.value[p] * j.slope[q];
            Quad line{}, sloped{}, curved{};
            for (int r = 0; r < 4; ++r) {
                const Quad tap = load<Quad>(field.coefficients + place + 4 * r);
                line += k.value[r] * tap, sloped += k.slope[r] * tap, curved += k.bend[r] * tap;
                if (by_coefficients == nullptr) continue;
                float* to = by_coefficients + place + 4 * r;
                store(to, load<Quad>(to) + k.value[r] * (value * by_u + by_i * by_slope[0] + by_j * by_slope[1]) +
                              k.slope[r] * value * by_slope[2]);
            }
            bent[0] += i.bend[p] * j.value[q] * line, bent[1] += i.slope[p] * j.slope[q] * line;
            bent[2] += by_i * sloped, bent[3] += i.value[p] * j.bend[q] * line;
            bent[4] += by_j * sloped, bent[5] += value * curved;
        }
    const int of[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};
    for (int b = 0; b < 3; ++b) {
        const Quad products = by_slope[0] * bent[of[0][b]] + by_slope[1] * bent[of[1][b]] + by_slope[2] * bent[of[2][b]];
        const float by_grid = products[0] + products[1] + products[2];
        for (int e = 0; e < 3; ++e) by_x[e] += by_grid * static_cast<float>(field.to_grid[b][e]);
    }
}

// `displace`, backwards: from the gradient by the displaced mean and by F to that by the mean, in its place, and by the
// coefficients of each field (null: not wanted).
inline void differentiate_displacement(const View& view, const float mean[3], float by_mean[3], const float by_map[3][3],
                                       float* const* by_fields) {
    Fielded at[kMaxFields];
    float before[kMaxFields + 1][3][3] = {{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};  // F up to each field
    double x[3] = {mean[0], mean[1], mean[2]};
    for (int f = 0; f < view.field_count; ++f) {
        at[f] = field_at(view.fields[f], x);
        multiply(at[f].map, before[f], before[f + 1]);
        for (int d = 0; d < 3; ++d) x[d] += at[f].moved[d];
    }
    float by_after[3][3];  // by F up to and with the field
    std::memcpy(by_after, by_map, sizeof by_after);
    for (int f = view.field_count - 1; f >= 0; --f) {
        float by_own[3][3], by_before[3][3], by_x[3];
        for (int d = 0; d < 3; ++d) {
            by_x[d] = at[f].map[0][d] * by_mean[0] + at[f].map[1][d] * by_mean[1] + at[f].map[2][d] * by_mean[2];
            for (int e = 0; e < 3; ++e) {
                by_own[d][e] = by_before[d][e] = 0;
                for (int m = 0; m < 3; ++m) {
                    by_own[d][e] += by_after[d][m] * before[f][e][m];
                    by_before[d][e] += at[f].map[m][d] * by_after[m][e];
                }
            }
        }
        differentiate_field(view.fields[f], at[f].taps, by_mean, by_own, by_x, by_fields ? by_fields[f] : nullptr);
        std::memcpy(by_mean, by_x, sizeof by_x);
        std::memcpy(by_after, by_before, sizeof by_after);
    }
}

}  // namespace

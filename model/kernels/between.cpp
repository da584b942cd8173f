#include "between.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "threads.hpp"

namespace ultragray {
namespace {

constexpr float kDegrees = 57.29577951308232f;

struct Grey {
    float value[256];
    Grey() {
        for (int level = 0; level < 256; ++level) value[level] = float(level) / 255.0f;
    }
};
const Grey kGrey;

// A row of pixels of a plane on a frame: grey values, and the weights by distance; 0 beside the image. `places` has room for
// two numbers a pixel.
void project(const uint8_t* image, int height, int width, const float* onto, const FrameLines& lines, int64_t first,
             float* places, float* values, float* weights) {
    const float *xs = lines.pixels + first, *zs = lines.pixels + int64_t(height) * width + first;
    const float by_length = 1.0f / lines.length, by_span = 1.0f / lines.span;
    const float by_z = 1.0f / lines.along_z, slope = lines.along_x / lines.along_z;
    float *rows = places, *columns = places + width;
    for (int j = 0; j < width; ++j) {
        const float x = onto[0] * xs[j] + onto[1] * zs[j] + onto[2], z = onto[6] * xs[j] + onto[7] * zs[j] + onto[8];
        rows[j] = z * by_z, columns[j] = x - z * slope;
        if (lines.fanned) rows[j] = std::sqrt(x * x + z * z), columns[j] = kDegrees * std::atan2(x, z);
    }
    for (int j = 0; j < width; ++j) {
        const float y = onto[3] * xs[j] + onto[4] * zs[j] + onto[5];
        rows[j] = (rows[j] - lines.near) * by_length, columns[j] = (columns[j] - lines.start) * by_span;
        weights[j] = 1.0f / std::max(std::fabs(y), lines.least_mm);
    }
    for (int j = 0; lines.wrap && j < width; ++j) columns[j] -= std::floor(columns[j]);
    const auto between = [](float a, float b, float share) { return a + share * (b - a); };
    for (int j = 0; j < width; ++j) {
        if (!(rows[j] >= 0 && rows[j] <= 1 && columns[j] >= 0 && columns[j] <= 1)) {
            values[j] = weights[j] = 0;
            continue;
        }
        // Bilinear, between the middles of pixels; beyond the outermost ones their values.
        const float down = std::min(std::max(rows[j] * height - 0.5f, 0.0f), float(height - 1));
        const float along = columns[j] * width - 0.5f;
        const float right = lines.wrap ? along : std::min(std::max(along, 0.0f), float(width - 1));
        const int top = int(down), left = int(right + 1.0f) - 1, below = std::min(top + 1, height - 1);
        const int from = left < 0 ? width - 1 : left, to = left + 1 < width ? left + 1 : lines.wrap ? 0 : width - 1;
        const uint8_t *upper = image + int64_t(top) * width, *lower = image + int64_t(below) * width;
        const float by_row = down - top, by_column = right - left;
        values[j] = between(between(kGrey.value[upper[from]], kGrey.value[upper[to]], by_column),
                            between(kGrey.value[lower[from]], kGrey.value[lower[to]], by_column), by_row);
    }
}

// Replaces values [size, lines] by their mean over `wide` places along the first axis, fewer at its ends.
inline __attribute__((always_inline)) void average(float* values, int size, int lines, int wide, std::vector<float>& copy,
                                                   std::vector<double>& sums) {
    const int half = wide / 2;
    copy.assign(values, values + int64_t(size) * lines);
    sums.assign(lines, 0.0);
    const auto add = [&](int place, double sign) {
        for (int line = 0; line < lines; ++line) sums[line] += sign * copy[int64_t(place) * lines + line];
    };
    for (int place = 0; place < std::min(half, size); ++place) add(place, 1);
    for (int place = 0; place < size; ++place) {
        const int enters = place + half, leaves = place - half - 1;
        if (enters < size) add(enters, 1);
        if (leaves >= 0) add(leaves, -1);
        const double share = 1.0 / (std::min(enters + 1, size) - std::max(leaves + 1, 0));
        for (int line = 0; line < lines; ++line)
            values[int64_t(place) * lines + line] = static_cast<float>(sums[line] * share);
    }
}

}  // namespace

void blend_between(const uint8_t* images, int height, int width, const int64_t* frames, int count, const float* shares,
                   const float* onto, const FrameLines& lines, const Doubt& doubt, int threads, float* blends,
                   float* weights) {
    const int64_t size = int64_t(height) * width;
    Phase planes{count, [&](int v) {
                     const uint8_t *first = images + frames[2 * v] * size, *second = images + frames[2 * v + 1] * size;
                     float *blend = blends + v * size, *weight = weights + v * size;
                     std::vector<float> differences(size), row(6 * width), copy;
                     std::vector<double> sums;
                     std::vector<uint8_t> seen(size, 1);
                     for (int64_t at = 0; onto == nullptr && at < size; ++at) {
                         const float a = kGrey.value[first[at]], b = kGrey.value[second[at]];
                         blend[at] = a + shares[v] * (b - a);
                         differences[at] = b - a;
                     }
                     for (int64_t at = 0; onto != nullptr && at < size; at += width) {
                         float *a = row.data(), *b = a + width, *by_a = b + width, *by_b = by_a + width,
                               *places = by_b + width;
                         project(first, height, width, onto + 18 * v, lines, at, places, a, by_a);
                         project(second, height, width, onto + 18 * v + 9, lines, at, places, b, by_b);
                         for (int j = 0; j < width; ++j) {
                             const float both = by_a[j] + by_b[j];
                             blend[at + j] = (by_a[j] * a[j] + by_b[j] * b[j]) / std::max(both, 1e-9f);
                             differences[at + j] = by_a[j] > 0 && by_b[j] > 0 ? b[j] - a[j] : 0.0f;
                             seen[at + j] = both > 0;
                         }
                     }
                     average(differences.data(), height, width, doubt.smoothed, copy, sums);
                     for (int i = 0; i < height; ++i)
                         average(differences.data() + int64_t(i) * width, width, 1, doubt.smoothed, copy, sums);
                     double sum = 0;
                     for (int64_t at = 0; at < size; ++at) sum += std::fabs(differences[at]);
                     const float usual = std::max(float(sum / size), doubt.nothing);
                     for (int64_t at = 0; at < size; ++at) {
                         const float off = differences[at] / (doubt.times * usual);
                         weight[at] = seen[at] ? 1.0f / (1.0f + off * off) : 0.0f;
                     }
                 }};
    run_phases({&planes}, threads);
}

void interpolate_planes(const uint8_t* images, int height, int width, const double* image_poses, const double* poses,
                        const int64_t* frames, int count, int most, const FrameLines& lines, int threads, float* planes) {
    const int64_t size = int64_t(height) * width;
    const float *xs = lines.pixels, *zs = lines.pixels + size;
    Phase each{count, [&](int c) {
                   std::vector<float> row(5 * width), grey(2 * size);
                   std::vector<float> distances(2 * size, std::numeric_limits<float>::infinity());
                   float *heights = row.data(), *values = heights + width, *weights = values + width;
                   float *places = weights + width, *above = distances.data(), *below = above + size;
                   for (int k = 0; k < most && frames[int64_t(c) * most + k] >= 0; ++k) {
                       const int64_t frame = frames[int64_t(c) * most + k];
                       const double *from = poses + 16 * c, *to = image_poses + 16 * frame;
                       float onto[9];
                       for (int d = 0; d < 3; ++d) {
                           double by_x = 0, by_z = 0, shift = 0;
                           for (int e = 0; e < 3; ++e) {
                               const double axis = to[4 * e + d];
                               by_x += axis * from[4 * e], by_z += axis * from[4 * e + 2];
                               shift += axis * (from[4 * e + 3] - to[4 * e + 3]);
                           }
                           onto[3 * d] = float(by_x), onto[3 * d + 1] = float(by_z), onto[3 * d + 2] = float(shift);
                       }
                       for (int64_t at = 0; at < size; at += width) {
                           int nearer = 0;
                           for (int j = 0; j < width; ++j) {
                               const float y = onto[3] * xs[at + j] + onto[4] * zs[at + j] + onto[5];
                               heights[j] = y;
                               nearer |= int(y >= 0 && y < above[at + j]) | int(y <= 0 && -y < below[at + j]);
                           }
                           if (!nearer) continue;
                           project(images + frame * size, height, width, onto, lines, at, places, values, weights);
                           for (int j = 0; j < width; ++j) {
                               if (!(weights[j] > 0)) continue;
                               const float y = heights[j];
                               if (y >= 0 && y < above[at + j]) above[at + j] = y, grey[at + j] = values[j];
                               if (y <= 0 && -y < below[at + j]) below[at + j] = -y, grey[size + at + j] = values[j];
                           }
                       }
                   }
                   for (int64_t at = 0; at < size; ++at) {
                       const float by_above = 1.0f / std::max(above[at], lines.least_mm);
                       const float by_below = 1.0f / std::max(below[at], lines.least_mm);
                       const float both = by_above + by_below;
                       planes[c * size + at] = both > 0 ? (by_above * grey[at] + by_below * grey[size + at]) / both : 0.0f;
                   }
               }};
    run_phases({&each}, threads);
}

}  // namespace ultragray

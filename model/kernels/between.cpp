#include "between.hpp"

#include <algorithm>
#include <cmath>
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

// A row of pixels of a plane on a frame: grey values, and the weights by distance; 0 beside the image.
void project(const uint8_t* image, int height, int width, const float* onto, const FrameLines& lines, int64_t first,
             float* values, float* weights) {
    const float *xs = lines.pixels + first, *zs = lines.pixels + int64_t(height) * width + first;
    for (int j = 0; j < width; ++j) {
        const float x = onto[0] * xs[j] + onto[1] * zs[j] + onto[2], y = onto[3] * xs[j] + onto[4] * zs[j] + onto[5];
        const float z = onto[6] * xs[j] + onto[7] * zs[j] + onto[8];
        const float depth = lines.fanned ? std::sqrt(x * x + z * z) : z / lines.along_z;
        const float across = lines.fanned ? kDegrees * std::atan2(x, z) : x - z * (lines.along_x / lines.along_z);
        const float row = (depth - lines.near) / lines.length;
        float column = (across - lines.start) / lines.span;
        if (lines.wrap) column -= std::floor(column);
        const bool inside = row >= 0 && row <= 1 && column >= 0 && column <= 1;
        weights[j] = inside ? 1.0f / std::max(std::fabs(y), lines.least_mm) : 0.0f;
        values[j] = 0;
        if (!inside) continue;
        // Bilinear, between the middles of pixels; beyond the outermost ones their values.
        const float down = std::clamp(row * height - 0.5f, 0.0f, float(height - 1)), along = column * width - 0.5f;
        const float right = lines.wrap ? along : std::clamp(along, 0.0f, float(width - 1));
        const int top = int(down), left = int(std::floor(right)), below = std::min(top + 1, height - 1);
        const int from = left < 0 ? width - 1 : left, to = left + 1 < width ? left + 1 : lines.wrap ? 0 : width - 1;
        const float by_row = down - top, by_column = right - left;
        const uint8_t *upper = image + int64_t(top) * width, *lower = image + int64_t(below) * width;
        const auto between = [](float a, float b, float share) { return a + share * (b - a); };
        values[j] = between(between(kGrey.value[upper[from]], kGrey.value[upper[to]], by_column),
                            between(kGrey.value[lower[from]], kGrey.value[lower[to]], by_column), by_row);
    }
}

// Replaces values [size, lines] by their mean over `wide` places along the first axis, fewer at its ends.
void average(float* values, int size, int lines, int wide, std::vector<float>& copy, std::vector<double>& sums) {
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
                     std::vector<float> differences(size), row(4 * width), copy;
                     std::vector<double> sums;
                     std::vector<uint8_t> seen(size, 1);
                     for (int64_t at = 0; onto == nullptr && at < size; ++at) {
                         const float a = kGrey.value[first[at]], b = kGrey.value[second[at]];
                         blend[at] = a + shares[v] * (b - a);
                         differences[at] = b - a;
                     }
                     for (int64_t at = 0; onto != nullptr && at < size; at += width) {
                         float *a = row.data(), *b = a + width, *by_a = b + width, *by_b = by_a + width;
                         project(first, height, width, onto + 18 * v, lines, at, a, by_a);
                         project(second, height, width, onto + 18 * v + 9, lines, at, b, by_b);
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

}  // namespace ultragray

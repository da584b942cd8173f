#include "footprint.hpp"

#include <algorithm>
#include <cmath>

namespace ultragray {
namespace {

constexpr double kTail = 24.0;           // squared standard deviations drawn below an opaque slice (kNegligible of draw.inl)
constexpr double kEarlyVariance = 3.24;  // cm2; beyond it an opaque slice is drawn from the first row (kEarlySigma)
constexpr double kClippedDepths = 6.4;   // standard deviations from depth 0 within which absorption takes exponentials
constexpr int64_t kClippedCost = 8;      // of a pixel there, measured
constexpr int64_t kSpareLines = 15;      // of the last vector
constexpr int64_t kSpareRows = 16;       // what a vector of lines costs before its first row

// Standard deviations squared of a slice, along its mean's scan line and across.
struct Spread {
    double along, across;
};

Spread spread_of(const View& view, const Slice& s) {
    if (!view.fanned) return {s.cov_zz, 0.0};  // its parallel lines are upright: depth is z whatever the line
    const double ex = s.depth > 0 ? s.mean_x / s.depth : 0.0, ez = s.depth > 0 ? s.mean_z / s.depth : 1.0;
    return {ex * ex * s.cov_xx + 2 * ex * ez * s.cov_xz + ez * ez * s.cov_zz,
            ez * ez * s.cov_xx - 2 * ex * ez * s.cov_xz + ex * ex * s.cov_zz};
}

int64_t pixels_of(const View& view, const Slice& s) {
    const Spread spread = spread_of(view, s);
    const double up = std::sqrt(std::max(0.0, kMaxM2 - s.m2_plane) * spread.along);
    const double room = std::max(0.0, kTail - s.m2_plane);
    const double down = std::hypot(s.depth + std::sqrt(room * spread.along), std::sqrt(room * spread.across));
    const bool clipped = s.depth < kClippedDepths * std::sqrt(spread.along) || spread.along > kEarlyVariance;
    const double top = spread.along > kEarlyVariance ? 0.0 : (s.depth - up - view.near) / view.row_step;
    const double end = ((view.fanned ? down : s.depth + std::sqrt(room * spread.along)) - view.near) / view.row_step;
    const double rows = std::clamp(end, 0.0, double(view.height)) - std::clamp(top, 0.0, double(view.height));
    const int64_t lines = int64_t(s.last) - s.first + 1;
    return (lines + kSpareLines) * (static_cast<int64_t>(std::max(0.0, rows)) * (clipped ? kClippedCost : 1) + kSpareRows);
}

}  // namespace

int64_t footprint_bound(const View& view, const SliceList& slices) {
    return (slices.lines + kSpareLines * slices.size()) * (view.height * kClippedCost + kSpareRows);
}

int64_t footprint_pixels(const View& view, const SliceList& slices) {
    int64_t pixels = 0;
    for (int64_t i = 0; i < slices.size(); ++i) pixels += pixels_of(view, slices.data()[i]);
    return pixels;
}

}  // namespace ultragray

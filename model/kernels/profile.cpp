#include "profile.hpp"

#include <algorithm>
#include <cmath>

namespace ultragray {
namespace {

double absorption_profile(double u) {
    const double low = std::min(u, 0.0) - 3.0, high = std::min(u, low + 6.0);
    const double half = 0.5 * (high - low), middle = 0.5 * (high + low), node = half * std::sqrt(0.6);
    const auto density = [](double t) { return std::exp(-0.5 * t * t); };
    return half * (8.0 * density(middle) + 5.0 * (density(middle - node) + density(middle + node))) / 9.0;
}

double absorption_slope(double u) {
    const double low = std::min(u, 0.0) - 3.0, high = std::min(u, low + 6.0), moves = u < 0.0 ? 1.0 : 0.0;
    const double half = 0.5 * (high - low), middle = 0.5 * (high + low);
    double slope = 0;
    for (const double node : {0.0, -std::sqrt(0.6), std::sqrt(0.6)}) {
        const double t = middle + half * node, density = std::exp(-0.5 * t * t), weight = (node == 0.0 ? 8.0 : 5.0) / 9.0;
        slope += weight * density * (0.5 * (1.0 - moves) - half * t * 0.5 * (1.0 + node + moves * (1.0 - node)));
    }
    return slope;
}

// Interpolates at the Chebyshev nodes of each step: next to the best parabola there.
ProfileTable make_table(double (*function)(double)) {
    ProfileTable table;
    for (int n = -ProfileTable::kSteps / 2; n < ProfileTable::kSteps / 2; ++n) {
        const double centre = 0.2 * n + 0.1, node = 0.1 * std::sqrt(0.75);
        const auto at = [&](double v) { return function(v + double(ProfileTable::kMiddle)); };
        const double left = at(centre - node), mid = at(centre), right = at(centre + node);
        const int k = n & (ProfileTable::kSteps - 1);
        const double slope = (right - left) / (2 * node), bend = (right - 2 * mid + left) / (2 * node * node);
        table.parabola[0][k] = static_cast<float>(mid - slope * centre + bend * centre * centre);
        table.parabola[1][k] = static_cast<float>(slope - 2 * bend * centre);
        table.parabola[2][k] = static_cast<float>(bend);
    }
    return table;
}

}  // namespace

const ProfileTable kProfile = make_table(absorption_profile);
const ProfileTable kProfileSlope = make_table(absorption_slope);

}  // namespace ultragray

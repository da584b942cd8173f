#include "profile.hpp"

#include <algorithm>
#include <cmath>

namespace ultragray {
namespace {

constexpr double kPi = 3.14159265358979323846, kLow = -3.4, kHigh = 3.0;

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

// Interpolates at the Chebyshev nodes of each piece: next to the best polynomial there.
template <class Table>
Table make_table(double (*function)(double)) {
    constexpr int terms = Table::kTerms, pieces = Table::kPieces;
    const double width = Table::kWidth, middle = Table::kMiddle;
    Table table;
    for (int n = -pieces / 2; n < pieces / 2; ++n) {
        const double low = std::max(n * width, kLow - middle), high = std::min((n + 1) * width, kHigh - middle);
        double nodes[terms], values[terms], polynomial[terms] = {};
        for (int k = 0; k < terms; ++k) {
            nodes[k] = 0.5 * (low + high) + 0.5 * (high - low) * std::cos((k + 0.5) * kPi / terms);
            values[k] = function(nodes[k] + middle);
        }
        for (int order = 1; order < terms; ++order)  // Newton's divided differences
            for (int k = terms - 1; k >= order; --k) values[k] = (values[k] - values[k - 1]) / (nodes[k] - nodes[k - order]);
        for (int k = terms - 1; k >= 0; --k) {  // multiplied out
            for (int power = terms - 1; power > 0; --power)
                polynomial[power] = polynomial[power - 1] - nodes[k] * polynomial[power];
            polynomial[0] = values[k] - nodes[k] * polynomial[0];
        }
        for (int power = 0; power < terms; ++power)
            table.term[power][n & (pieces - 1)] = static_cast<float>(polynomial[power]);
    }
    return table;
}

}  // namespace

const FineProfile kFineProfile = make_table<FineProfile>(absorption_profile);
const FineProfile kFineProfileSlope = make_table<FineProfile>(absorption_slope);
const CoarseProfile kCoarseProfile = make_table<CoarseProfile>(absorption_profile);
const CoarseProfile kCoarseProfileSlope = make_table<CoarseProfile>(absorption_slope);

}  // namespace ultragray

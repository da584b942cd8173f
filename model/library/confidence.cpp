#include "confidence.hpp"

#include <algorithm>
#include <limits>

namespace ultragray::library {
namespace {

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
constexpr int kPointsPerSide = 6;

double mean_of(const std::vector<double>& values) {
    double sum = 0;
    for (const double one : values) sum += one;
    return sum / double(values.size());
}

ImageEdges edges_of(const Probing& probe) {
    const float near = float(probe.near_mm), far = float(probe.far_mm);
    if (probe.wraps()) return {true, 0.0f, 0.0f, 0.0f, 0.0f, 1.0f, near, far};  // there are no edges
    const double angle = (probe.is_angular() ? probe.span / 2 : probe.steering_deg) * (kPi / 180.0);
    const double x = std::sin(angle), z = std::cos(angle);
    if (probe.is_angular()) return {true, 0.0f, float(z), float(x), 0.0f, 1.0f, near, far};
    return {false, float(x / z), float(z), 0.0f, float(probe.span / 2 * z), float(1.0 / z), near, far};
}

}  // namespace

TrainingViews training_views(const std::vector<Pose>& poses, const Probing& probe) {
    std::vector<double> matrices;
    for (const Pose& pose : poses) {
        const std::array<double, 16> matrix = pose.matrix();
        matrices.insert(matrices.end(), matrix.begin(), matrix.end());
    }
    return {matrices.data(), poses.size(), edges_of(probe), "auto"};
}

ViewMeasures measure(const TrainingViews& views, const Pose& pose, const Probing& probe, int points_per_side) {
    std::vector<double> points;
    for (int row = 0; row < points_per_side; ++row)
        for (int column = 0; column < points_per_side; ++column) {
            const Ray ray = probe.ray(probe.across(column, points_per_side));
            const Vector point = ray.at(probe.depth_mm(row, points_per_side));
            points.insert(points.end(), point.begin(), point.end());
        }
    return views.measure(pose.matrix().data(), points.data(), points.size() / 3);
}

ConfidenceModel ConfidenceModel::read(const Value& value) {
    ConfidenceModel model;
    constexpr int64_t kVersion = 2;
    const Range positive{{}, {}, 0.0}, at_least_0{0.0, {}, {}}, share{0.0, 1.0, {}};
    const auto unless_null = [](const auto& read) {
        return [read](const Value& it) {
            if (!it.json().is_null()) read(it);
        };
    };
    Fields fields(value, "confidence");
    fields.require("version", [&](const Value& it) { it.integer({double(kVersion), double(kVersion), {}}); });
    fields.require("weights", [&](const Value& it) {
        model.formula.weights = it.vector<5>({});
        for (size_t k = 1; k < model.formula.weights.size(); ++k) it.at(k).number(at_least_0);
    });
    fields.require("black_ms_ssim", [&](const Value& it) { model.formula.black_ms_ssim = it.number(share); });
    fields.require("hardness", [&](const Value& it) { model.formula.hardness = it.numbers({}, {}); });
    fields.require("fitted_on", [&](const Value& it) { it.integer({1.0, {}, {}}); });
    fields.require("error", [&](const Value& it) { it.number(share); });
    fields.require("support", unless_null([&](const Value& it) {
                       Fields support(it, "support");
                       auto& [gain, share, reach_mm] = model.formula.support.emplace();
                       for (auto [name, into] : {std::pair("gain", &gain), {"share", &share}, {"reach_mm", &reach_mm}})
                           support.require(name, [&, into = into](const Value& one) { *into = one.number(positive); });
                       support.end();
                   }));
    fields.require("fitted_to_mm",
                   unless_null([&](const Value& it) { model.formula.fitted_to_mm = it.number(at_least_0); }));
    fields.require("uncertainty", unless_null([&](const Value& it) {
                       Fields uncertainty(it, "uncertainty");
                       Uncertainty& of = model.uncertainty.emplace();
                       uncertainty.require("variances",
                                           [&](const Value& one) { of.variances = one.vector<10>(at_least_0); });
                       uncertainty.require("level", [&](const Value& one) { of.level = one.vector<8>(at_least_0); });
                       uncertainty.require("spread", [&](const Value& one) { of.spread = one.vector<8>(at_least_0); });
                       uncertainty.end();
                   }));
    fields.end();
    return model;
}

Extrapolation assess(const TrainingViews* views, const ConfidenceModel* model, const Pose& pose, const Probing& probe) {
    Extrapolation found{kNaN, kNaN, kNaN, kNaN, kNaN, kNaN, kNaN};
    if (views == nullptr) return found;
    const ViewMeasures measures = measure(*views, pose, probe, kPointsPerSide);
    found.distance_mm = mean_of(measures.nearest_mm);
    found.angle_deg = mean_of(measures.angle_deg);
    if (model)
        found.confidence =
            model->formula.predict(measures.distance_mm.data(), measures.interpolation_mm.data(), measures.angle_deg.data(),
                                   measures.distance_mm.size(), measures.weights.data());
    return found;
}

void add_support(Extrapolation& found, const ConfidenceModel* model, double supported_share) {
    found.supported_share = supported_share;
    if (model && !std::isnan(found.confidence)) found.confidence = model->formula.limited(found.confidence, supported_share);
}

namespace {

constexpr int kCells = 32, kDepths = 8;  // cells a side, no more than pixels

using Map = std::vector<float>;

// Means over h x w cells of equal size, which share pixels where these do not divide.
Map in_cells(const Map& plane, int height, int width, int h, int w) {
    Map means;
    const auto first = [](int cell, int pixels, int cells) { return cell * pixels / cells; };
    const auto last = [](int cell, int pixels, int cells) { return ((cell + 1) * pixels + cells - 1) / cells; };
    for (int i = 0; i < h; ++i)
        for (int j = 0; j < w; ++j) {
            const int top = first(i, height, h), bottom = last(i, height, h);
            const int left = first(j, width, w), right = last(j, width, w);
            float sum = 0;
            for (int row = top; row < bottom; ++row)
                for (int column = left; column < right; ++column) sum += plane[size_t(row) * width + column];
            means.push_back(sum / float(bottom - top) / float(right - left));
        }
    return means;
}

// Bilinear between the middles of h x w cells; beyond the outermost ones their values.
Map interpolated(const Map& map, int h, int w, int height, int width) {
    struct Place {
        int low, high;
        float share;
    };
    const auto places = [](int count, int cells) {
        std::vector<Place> found;
        for (int k = 0; k < count; ++k) {
            const float at = std::max((k + 0.5f) * (float(cells) / float(count)) - 0.5f, 0.0f);
            const int low = std::min(int(at), cells - 1);
            found.push_back({low, std::min(low + 1, cells - 1), at - float(low)});
        }
        return found;
    };
    const std::vector<Place> rows = places(height, h), columns = places(width, w);
    Map found;
    for (const Place& i : rows)
        for (const Place& j : columns) {
            const float *above = &map[size_t(i.low) * w], *below = &map[size_t(i.high) * w];
            const float upper = above[j.low] * (1.0f - j.share) + above[j.high] * j.share;
            const float lower = below[j.low] * (1.0f - j.share) + below[j.high] * j.share;
            found.push_back(upper * (1.0f - i.share) + lower * i.share);
        }
    return found;
}

}  // namespace

// The variances that add up to that of a pixel's error, in cells: the terms are those of ultragray.rendering.derived, in
// their order; V is the mean squared error of a pixel that shows the cell's mean where the true grey value may be any that
// training images have at its depth.
std::vector<float> deviations(const ConfidenceModel::Uncertainty& model, const ViewMeasures& measures, const Seen& seen,
                              int height, int width) {
    const int h = std::min(kCells, height), w = std::min(kCells, width);
    Map squares;
    for (const float grey : seen.bmode) squares.push_back(grey * grey);
    const Map mean = in_cells(seen.bmode, height, width, h, w), square = in_cells(squares, height, width, h, w);
    const Map coverage = in_cells(seen.coverage, height, width, h, w);
    const Map transmittance = in_cells(seen.transmittance, height, width, h, w);
    const auto over_cells = [&](const auto& values, int rows, int columns, int wide) {
        return interpolated(Map(values.begin(), values.end()), rows, columns, h, wide);
    };
    const Map apart = over_cells(measures.interpolation_mm, kUncertaintyPoints, kUncertaintyPoints, w);
    const Map away = over_cells(measures.distance_mm, kUncertaintyPoints, kUncertaintyPoints, w);
    const Map level = over_cells(model.level, kDepths, 1, 1), spread = over_cells(model.spread, kDepths, 1, 1);
    Map found;
    for (size_t k = 0; k < mean.size(); ++k) {
        const float grey = mean[k], off = level[k / w] - grey, unknown = spread[k / w] + off * off;
        const float terms[10] = {1e-3f,
                                 0.1f * grey,
                                 grey * grey,
                                 std::max(square[k] - grey * grey, 0.0f),
                                 -std::expm1(-apart[k] / 0.3f) * unknown,
                                 -std::expm1(-apart[k]) * unknown,
                                 -std::expm1(-apart[k] / 3.0f) * unknown,
                                 -std::expm1(-away[k] / 5.0f) * unknown,
                                 (1.0f - coverage[k]) * unknown,
                                 0.1f * (1.0f - transmittance[k]) * grey};
        float sum = 0;
        for (size_t term = 0; term < model.variances.size(); ++term) sum += float(model.variances[term]) * terms[term];
        found.push_back(std::sqrt(std::clamp(sum, 0.0f, 1.0f)));
    }
    return interpolated(found, h, w, height, width);
}

}  // namespace ultragray::library

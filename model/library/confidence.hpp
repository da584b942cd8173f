// How far a frame extrapolates from what its scene was trained on, and how much to trust it (ultragray.scene.confidence).
#pragma once

#include "../kernels/assess.hpp"
#include "geometry.hpp"
#include "ultragray.h"

namespace ultragray::library {

using Extrapolation = ultragray_extrapolation;

// The images of a scene's training views, one or more.
TrainingViews training_views(const std::vector<Pose>& poses, const Probing& probe);
// Of a grid of points of a pose's image, row by row.
ViewMeasures measure(const TrainingViews& views, const Pose& pose, const Probing& probe, int points_per_side);

// What training fitted.
struct ConfidenceModel {
    struct Uncertainty {  // of pixels
        std::array<double, 10> variances;
        std::array<double, 8> level, spread;  // by depth
    };
    ConfidenceFormula formula;
    std::optional<Uncertainty> uncertainty;

    static ConfidenceModel read(const Value& value);
};

constexpr float kSupportCoverage = 0.3f;  // less does not support a pixel

// What the pose alone tells; NaN is not known. Views and model may be null.
Extrapolation assess(const TrainingViews* views, const ConfidenceModel* model, const Pose& pose, const Probing& probe);
// Completes it with the share of the frame's pixels that has support.
void add_support(Extrapolation& found, const ConfidenceModel* model, double supported_share);

// The planes [H, W] that the output `uncertainty` follows from, and the output: the expected standard deviation of B-mode.
struct Seen {
    const std::vector<float>&bmode, &coverage, &transmittance;
};
std::vector<float> deviations(const ConfidenceModel::Uncertainty& model, const ViewMeasures& measures, const Seen& seen,
                              int height, int width);
constexpr int kUncertaintyPoints = 12;  // a side, of its measures

}  // namespace ultragray::library

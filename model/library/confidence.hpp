// How far a frame extrapolates from what its scene was trained on, and how much to trust it (ultragray.scene.confidence).
#pragma once

#include "geometry.hpp"
#include "ultragray.h"

namespace ultragray::library {

using Extrapolation = ultragray_extrapolation;

// Of K points of a pose's image, row by row, and of P training views around it: see the class of this name in Python.
struct ViewMeasures {
    std::vector<double> nearest_mm, distance_mm, interpolation_mm, angle_deg;  // [K]
    std::vector<double> weights;                                               // [P], their sum is 1
};

// The images of training views of one probe, in space; one or more.
class TrainingViews {
 public:
    TrainingViews(const std::vector<Pose>& poses, const Probing& probe);
    ViewMeasures measure(const Pose& pose, const Probing& probe, int points_per_side) const;

 private:
    Probing probe_;
    size_t count_;
    std::vector<Pose> filled_;           // [P'], a whole number of vectors
    std::vector<float> axes_, offsets_;  // [axis, xyz, P'], [axis, P']
};

// The weights that training fitted.
struct ConfidenceModel {
    struct Support {
        double gain, share, reach_mm;
    };
    struct Uncertainty {  // of pixels
        std::array<double, 10> variances;
        std::array<double, 8> level, spread;  // by depth
    };
    std::array<double, 5> weights;
    double black_ms_ssim;
    std::vector<double> hardness;  // [P]
    std::optional<Support> support;
    std::optional<double> fitted_to_mm;
    std::optional<Uncertainty> uncertainty;

    static ConfidenceModel read(const Value& value);
    double predict(const ViewMeasures& measures) const;
    double limited(double confidence, double supported_share) const;
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

// How poses lie to the training views of a scene, and the confidence in their frames: ultragray.scene.confidence, for the
// extension module and the library.
#pragma once

#include <array>
#include <optional>
#include <string>
#include <vector>

#include "views.hpp"

namespace ultragray {

// Of K points of a pose's image, and of P training views around it: see the class of this name in Python.
struct ViewMeasures {
    std::vector<double> nearest_mm, distance_mm, interpolation_mm, angle_deg;  // [K]
    std::vector<double> around_mm;  // [P] root of the mean square of the points' distances
    std::vector<double> weights;    // [P], their sum is 1
};

// The images of training views of one probe, in space; one or more.
class TrainingViews {
 public:
    TrainingViews(const double* poses, size_t count, const ImageEdges& edges,
                  const std::string& instruction_set);  // [P, 4, 4] mm
    size_t count() const { return count_; }
    // Of a pose [4, 4], mm, and points [K, 3] of the frame of its probe, mm.
    ViewMeasures measure(const double* pose, const double* points, size_t count) const;
    // `interpolation_mm` of points [K, 3] of the scene's frame, mm.
    void interpolation_mm(const float* points, size_t count, double* found) const;

 private:
    struct Distances {
        std::vector<float> nearest, before, behind, around;
        std::vector<int64_t> place;
    };
    Distances distances(const float* points, size_t count, const float* angles, const float* facing) const;

    size_t count_;
    ImageEdges edges_;
    std::string instruction_set_;
    std::vector<double> filled_;         // [P', 4, 4]: a whole number of vectors
    std::vector<float> axes_, offsets_;  // [axis, xyz, P'], [axis, P']
};

// c = b + (1 - b) mean over points of σ(w0 - w1 log(1 + i/0.3 mm) - w2 d/5 mm - w3 φ/10° - w4 h), limited by support.
struct ConfidenceFormula {
    struct Support {
        double gain, share, reach_mm;
    };
    std::array<double, 5> weights;
    double black_ms_ssim;
    std::vector<double> hardness;  // [P]
    std::optional<Support> support;
    std::optional<double> fitted_to_mm;

    // Of K points each, and the weights of P views.
    double predict(const double* distance_mm, const double* interpolation_mm, const double* angle_deg, size_t count,
                   const double* views) const;
    double limited(double confidence, double supported_share) const;
};

}  // namespace ultragray

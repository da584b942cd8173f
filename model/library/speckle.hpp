// Speckle of scatterers that are fixed in the tissue: the grids that its kernel takes (ultragray.rendering.speckle says what
// is drawn, and why).
#pragma once

#include "geometry.hpp"

namespace ultragray::library {

// The grid of samples for frames of one size by one probe, and their weights.
struct SpeckleSamples {
    SpeckleSamples(const SpeckleModel& model, const Probing& probe, int height, int width);

    Probing probe;
    int height, width, rows, columns, row_step, column_step, row_taps, column_taps;
    int first_row, first_column;  // of the samples, in the image: before it
    std::vector<float> row_weights, column_weights, plane_weights;
};

class SpeckleOfScene {
 public:
    // Of a model and of the training poses in the tissue at rest.
    SpeckleOfScene(const SpeckleModel& model, const std::vector<Pose>& poses);
    const SpeckleModel& model() const { return model_; }
    // B-mode [H, W] with the speckle of a pose in the tissue at rest. Throws std::bad_alloc.
    std::vector<float> added(const std::vector<float>& bmode, const SpeckleSamples& samples, const Pose& pose,
                             int threads) const;

 private:
    SpeckleModel model_;
    Vector axial_;     // of the sweep
    Matrix to_cells_;  // from mm
    double first_look_, mean_, deviation_;
};

}  // namespace ultragray::library

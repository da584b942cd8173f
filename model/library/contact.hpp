// Contact of a probe with the skin under a scene's training views (ultragray.rendering.contact).
#pragma once

#include "geometry.hpp"

namespace ultragray::library {

// Heights of the outermost and the innermost training face over a plane, in cells.
class Skin {
 public:
    // Under the training views of a probe. Throws Fault where there is none: no views or no probe are known, or they look
    // all around.
    Skin(const std::vector<Pose>& poses, const std::optional<Probe>& probe);

    enum class Side { Outermost, Innermost };  // the skin at rest, and as far as a face has pressed it
    // The way from points to a side along unit directions, mm, less than 0 where it lies behind; infinite where no skin is
    // known, and along a direction that does not run into the body.
    std::vector<double> distances_mm(const std::vector<Vector>& points, const std::vector<Vector>& directions,
                                     Side side) const;

 private:
    void settle(const std::vector<Vector>& points);

    Vector origin_;  // the centre of the first cell, at height 0
    Matrix axes_;    // along rows, along columns, out of the body
    double cell_mm_;
    int rows_, columns_;
    std::vector<float> outermost_, innermost_;  // [rows, columns] mm
    std::vector<bool> known_;                   // a face was near
};

// Where the scan lines of one pose meet the skin.
struct Touch {
    Touch(const Skin& skin, const Probing& probe, const Pose& pose, int width);

    std::vector<bool> lines;        // [W]: those that have contact
    std::vector<double> depths_mm;  // [W]: how far the face lies beyond the innermost training face; 0 for the others
    int count;                      // of those that have contact
};

}  // namespace ultragray::library

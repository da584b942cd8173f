// Tissue that goes along with the probe: from poses as tracked to the tissue at rest (ultragray.scene.tissue).
#pragma once

#include "scene_file.hpp"

namespace ultragray::library {

class FollowingTissue {
 public:
    // Of a scene that has shares, and poses at rest.
    explicit FollowingTissue(const Scene& scene);
    Pose at_rest(const Pose& pose) const;

 private:
    // Poses of frames, and places beside them, told by the corners of the images.
    class Path {
     public:
        Path(const std::vector<Pose>& poses, const Probing& probe);
        // The frames nearest to a pose, and their weights, of which the sum is 1.
        std::vector<std::pair<size_t, double>> nearest(const Pose& pose) const;
        Pose at(const std::vector<std::pair<size_t, double>>& place) const;

     private:
        std::vector<double> corners_from(const Pose& pose) const;
        std::vector<Pose> poses_;
        std::vector<Vector> own_;  // corners in the probe's frame
        std::vector<std::vector<double>> corners_;
        double spacing_mm_;
    };
    using Way = std::array<double, 6>;  // along the axes of a pose: shift of the middle of the image, mm, and turn, rad
    Way way(const Pose& before, const Pose& after) const;
    Pose moved(const Pose& pose, const Way& way) const;

    Vector shares_, middle_;
    Path tracked_, at_rest_;
    Vector sticking_{};
};

}  // namespace ultragray::library

// How far points lie from the images of training views (ultragray.scene.confidence).
#pragma once

#include <cstdint>

namespace ultragray {

// The images of P views, P a multiple of kMaxLanes: axis a of a view's frame as [a, xyz, P], and the origin's coordinate
// along each, [a, P]; mm. A point at x and z of that frame lies scale |x - slope z| - across z - half mm off the outermost
// scan lines (below 0: between them), and at a depth of z * by_z or, where the lines fan out from the origin, of its
// distance to that.
struct ViewImages {
    const float *axes, *offsets;
    int64_t count;
    bool fanned;
    float slope, scale, across, half, by_z;
    float near, far;  // the depths of the image
};

// Limits of distances in mm, and what is added to one for each degree between the frames, to choose the nearest view.
struct ViewLimits {
    float least, most, by_degree;
};

// Of each of K points: the distance to the nearest image, and to the nearest one before and behind, mm; the place of that
// nearest view. Of each view: the root mean square of the distances of all points.
struct ViewDistances {
    float *nearest, *before, *behind;  // [K]
    int64_t* place;                    // [K]
    float* around;                     // [P]
};

}  // namespace ultragray

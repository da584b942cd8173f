// How far points lie from the images of training views (ultragray.scene.confidence).
#pragma once

#include <cstdint>

namespace ultragray {

// A point at x and z of a probe's frame, mm, lies scale |x - slope z| - across z - half mm off the outermost scan lines of
// its image (below 0: between them), and at a depth of z * by_z or, where the lines fan out from the origin, of its
// distance to that.
struct ImageEdges {
    bool fanned;
    float slope, scale, across, half, by_z;
    float near, far;  // the depths of the image
};

// The images of P views, P a multiple of kMaxLanes: axis a of a view's frame as [a, xyz, P], and the origin's coordinate
// along each, [a, P]; mm.
struct ViewImages : ImageEdges {
    const float *axes, *offsets;
    int64_t count;
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

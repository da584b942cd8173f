// Planes between two frames each, as the training expects them.
#pragma once

#include <cstdint>

namespace ultragray {

// How a pixel of a plane is found on a frame; lengths and distances in mm, angles in degrees.
struct FrameLines {
    bool fanned, wrap;       // lines fan out from the origin, all the way round
    float along_x, along_z;  // the direction of parallel lines
    float start, span, near, length;
    const float* pixels;  // [2, H W] x and z of each pixel in its own frame
    float least_mm;       // distances from a frame are at least that
};

struct Doubt {
    int smoothed;   // pixels, odd, over which differences are averaged
    float times;    // of the mean difference: there the weight is a half
    float nothing;  // a mean difference is at least that
};

// For each of V planes, [V, H, W] both: the blend of its two frames, and its weight by how far they agree. `frames` [V, 2]
// are places among the images [F, H, W]. Blends are pixel by pixel with `shares` [V] of the second frame, or, where `onto`
// is not null, in space: it holds x, y and z on each frame as [V, 2, 3, 3] times (x, z, 1) of a pixel of the plane. The
// result does not depend on the number of threads.
void blend_between(const uint8_t* images, int height, int width, const int64_t* frames, int count, const float* shares,
                   const float* onto, const FrameLines& lines, const Doubt& doubt, int threads, float* blends,
                   float* weights);

}  // namespace ultragray

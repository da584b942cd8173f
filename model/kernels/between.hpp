// Planes as the frames beside them say that they look.
#pragma once

#include <cstdint>

namespace ultragray {

// How a pixel of a plane is found on a frame; lengths and distances in mm, angles in degrees.
struct FrameLines {
    bool fanned, wrap;       // lines fan out from the origin, all the way round
    float along_x, along_z;  // the direction of parallel lines
    float start, span, near, length;
    float least_mm;       // distances from a frame are at least that
    const float* pixels;  // [2, H W] x and z of each pixel in its own frame
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

// For each of C poses, [C, H, W]: each pixel from the nearest frame on either side of it, weighted by the inverse of their
// distances; 0 where no frame shows it. `frames` [C, K] are places among the images, of equally near ones the first counts;
// -1 stands behind the last. Poses, of images and of planes, are [4, 4] in mm.
void interpolate_planes(const uint8_t* images, int height, int width, const double* image_poses, const double* poses,
                        const int64_t* frames, int count, int most, const FrameLines& lines, int threads, float* planes);

}  // namespace ultragray

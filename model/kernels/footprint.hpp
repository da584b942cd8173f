// The cost of a frame before it is drawn: the pixels in the footprints of its slices.
#pragma once

#include "kernel.hpp"

namespace ultragray {

// Pixels that the slices may touch, at least, where all of them reach over the whole depth: quick, and never too small.
int64_t footprint_bound(const View& view, const SliceList& slices);

// Pixels of the slices' footprints as rectangles, with the margins that drawing adds to each; what is slow to draw counts
// as more. Within a factor of about three of the time that it takes.
int64_t footprint_pixels(const View& view, const SliceList& slices);

}  // namespace ultragray

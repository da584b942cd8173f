// Speckle on many threads.
#pragma once

#include <string>

#include "kernel.hpp"

namespace ultragray {

// Frames [C, H, W] with speckle in them, by one view each; without frames the speckle itself. The result depends neither on
// the number of threads nor on the frames beside.
void add_speckle(const SpeckleGrid& grid, const SpeckleView* views, int count, int threads,
                 const std::string& instruction_set, const float* bmode, float* out);

}  // namespace ultragray

// What is drawn at random for the frame of a pose, as NumPy draws it (ultragray.rendering.display).
#pragma once

#include "geometry.hpp"

namespace ultragray::library {

// Two numbers from 0 to 1 that follow from seed and pose: of gain and dynamic range.
std::array<double, 2> drawn_shares(uint64_t seed, const Pose& pose);

}  // namespace ultragray::library

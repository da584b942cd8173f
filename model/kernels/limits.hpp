// Limits of a rendering: the cost of a frame, and a flag by which another thread or process ends it.
#pragma once

#include <cstdint>
#include <exception>
#include <limits>

namespace ultragray {

// The flag was raised in the middle of a rendering.
class GivenUp : public std::exception {
 public:
    const char* what() const noexcept override { return "the rendering was given up"; }
};

// A frame would cost more than it may; nothing of it was drawn.
class TooCostly : public std::exception {
 public:
    TooCostly(int pose, int64_t footprint_pixels) : pose(pose), footprint_pixels(footprint_pixels) {}
    const char* what() const noexcept override { return "a frame exceeds the limit of footprint pixels"; }
    const int pose;
    const int64_t footprint_pixels;
};

struct Limits {
    int64_t footprint_pixels = std::numeric_limits<int64_t>::max();  // of one frame, see footprint.hpp
    const int64_t* flag = nullptr;  // raised once it holds at least `number`; others may write it at any time
    int64_t number = 0;

    // Throws GivenUp.
    void check_flag() const {
        if (flag != nullptr && __atomic_load_n(flag, __ATOMIC_RELAXED) >= number) throw GivenUp();
    }
};

}  // namespace ultragray

// Frames of many poses on many threads.
#pragma once

#include <string>
#include <vector>

#include "scene.hpp"

namespace ultragray {

// Geometry as the Python side knows it, in cm and radians.
struct ProbeGeometry {
    bool convex;
    double width;    // linear
    double opening;  // convex, full angle
    double near, far, cull_far;
};

// Output planes, each [C, H, W] or null.
struct Outputs {
    float *bmode, *echo, *transmittance, *coverage;
};

// Renders C poses [4, 4] (row-major, cm, probe to scene). The result does not depend on the number of threads.
// Throws std::bad_alloc, or std::invalid_argument for an instruction set that this processor lacks.
void render(const PreparedScene& scene, const ProbeGeometry& probe, const double* poses, int count, int height, int width,
            int threads, const std::string& instruction_set, const Outputs& outputs);

// The instruction sets this processor can run, best first; "auto" takes the first.
std::vector<std::string> instruction_sets();

}  // namespace ultragray

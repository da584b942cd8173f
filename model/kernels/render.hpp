// Frames of many poses on many threads.
#pragma once

#include <array>
#include <limits>
#include <memory>
#include <string>
#include <vector>

#include "kernel.hpp"
#include "limits.hpp"
#include "scene.hpp"

namespace ultragray {

// Geometry as the Python side knows it, in cm and radians.
struct ProbeGeometry {
    bool fanned, wrap;
    double start, span;  // of the scan lines, as in View
    double near, far, cull_far;
    Beam beam;
    bool uncut = false;  // Gaussians count wherever their means lie
};

// A displacement of tissue (`Field`) in the sweep's frame, the same for all poses or another for each.
struct Displacement {
    const float* coefficients;  // [C or 1, X, Y, Z, 3] mm
    const double* to_grid;      // [C or 1, 3, 4] of x, y, z, 1 in mm
    int size[3];
    bool has_many, has_many_places;   // C of them
    std::array<double, 3> centre_mm;  // of the scene
    int64_t floats() const { return int64_t(3) * size[0] * size[1] * size[2]; }
};
using Displacements = std::vector<Displacement>;  // one after another, at most kMaxFields

// The scan lines that are drawn, of whole strips; the others' pixels are left as they are.
struct Lines {
    int first = 0, end = std::numeric_limits<int>::max();
};
inline constexpr int kStripLines = 64;  // four accumulators of 512 rows stay within a 1 MB cache

// Renders C poses [4, 4] (row-major, cm, probe to scene; columns 0 and 2 may be those of a plane that is sheared such that
// its parallel lines run along z). The result does not depend on the number of threads.
// Throws GivenUp, TooCostly, std::bad_alloc, or std::invalid_argument for an instruction set that this processor lacks.
void render(const PreparedScene& scene, const ProbeGeometry& probe, const double* poses, int count, int height, int width,
            int threads, const std::string& instruction_set, const Outputs& outputs, const Limits& limits,
            const Lines& drawn = {}, const Displacements& displacements = {});

// The cost of each pose [C] in footprint pixels (footprint.hpp), without drawing it. Throws GivenUp, std::bad_alloc.
void footprints(const PreparedScene& scene, const ProbeGeometry& probe, const double* poses, int count, int height,
                int width, int threads, const std::string& instruction_set, const Limits& limits, int64_t* pixels,
                const Displacements& displacements = {});

// What drawing each strip of scan lines of the poses takes, [C, strips], without drawing.
std::vector<Work> drawing_work(const PreparedScene& scene, const ProbeGeometry& probe, const double* poses, int count,
                               int height, int width, int threads, const std::string& instruction_set);

// Frames that remember what their gradients need. The scene must outlive the recording.
class Recording {
 public:
    // As `render`. Throws std::invalid_argument for a sorted scene: its gradients would come in another order.
    Recording(const PreparedScene& scene, const ProbeGeometry& probe, const double* poses, int count, int height, int width,
              int threads, const std::string& instruction_set, const Outputs& outputs,
              const Displacements& displacements = {});
    ~Recording();

    // From the gradients of a loss with respect to the outputs (null: zero) to those with respect to the raw parameters,
    // which are overwritten, and by the views [C] and the coefficients of each displacement, zero before, where they are
    // wanted (not null); returns those with respect to the beam. The result does not depend on the number of threads.
    BeamMoments differentiate(const Outputs& gradients, const RawGradients& out, ViewGradient* views,
                              const std::vector<float*>& by_displacements, int threads) const;

    int count() const { return count_; }
    int height() const { return height_; }
    int width() const { return width_; }
    int64_t gaussian_count() const { return scene_.view().count; }
    int harmonics() const;  // K
    const Displacements& displacements() const { return displacements_; }

 private:
    struct State;
    const PreparedScene& scene_;
    int count_, height_, width_;
    Displacements displacements_;
    std::unique_ptr<State> state_;  // null for no poses
};

// The instruction sets this processor can run, best first; "auto" takes the first.
std::vector<std::string> instruction_sets();

}  // namespace ultragray

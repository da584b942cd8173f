// A scene made ready for rendering: activated, sorted along a space-filling curve, clustered (docs/physics.md §2, §5.4).
#pragma once

#include <vector>

#include "kernel.hpp"

namespace ultragray {

// Raw parameters as a checkpoint holds them, contiguous float32.
struct RawSplats {
    const float *means, *scales, *quats, *transmittances, *sh0, *shn;
    int64_t count;
    int sh_degree;
    Intensity intensity;
};

class PreparedScene {
 public:
    explicit PreparedScene(const RawSplats& raw);
    SceneView view() const;
    int64_t bytes() const;

 private:
    std::vector<Gaussian> gaussians_;
    std::vector<float> sh_;
    std::vector<Cluster> clusters_;
    int sh_degree_;
    Intensity intensity_;
};

}  // namespace ultragray

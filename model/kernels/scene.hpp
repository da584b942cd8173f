// A scene made ready for rendering: activated, sorted along a space-filling curve, clustered (docs/physics.md §2, §5.2).
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
    bool weighted;  // transmittances are the logits of weights
};

// Gradients with respect to them, of the same shapes.
struct RawGradients {
    float *means, *scales, *quats, *transmittances, *sh0, *shn;
};

// Sorted: for rendering many frames. AsGiven: for one training step, where sorting would cost more than it saves.
enum class Order { Sorted, AsGiven };

class PreparedScene {
 public:
    PreparedScene(const RawSplats& raw, Order order, int threads);
    SceneView view() const;
    Order order() const { return order_; }
    // From gradients with respect to activated Gaussians, [N] and sh [N, K], to raw ones. Only for a scene in its given
    // order.
    void to_raw(const GaussianGradient* gaussians, const float* sh, const RawGradients& out, int threads) const;
    int64_t bytes() const;

 private:
    std::vector<Gaussian> gaussians_;
    std::vector<float> sh_;
    std::vector<float> quat_norms_;  // for gradients only: none in a sorted scene
    Order order_;
    std::vector<Cluster> clusters_;
    int sh_degree_;
    Intensity intensity_;
    bool weighted_;
};

}  // namespace ultragray

// The parts of the training loss on many threads. Results do not depend on their number.
#pragma once

#include <cstdint>
#include <string>

namespace ultragray {

// (1 - texture) mean |x - y| + texture (1 - SSIM) of images [C, H, W], both sides at least 11, and its gradient by x,
// [C, H, W]. The last `weighted` images count by weights [weighted, H, W]: for x stands y + weight (x - y).
double image_loss(const float* x, const float* y, int count, int height, int width, const float* weights, int weighted,
                  double texture, int threads, const std::string& instruction_set, float* gradient);

// The price of absorption: `factor` times the mean over [C, size] of 1 - transmittance where neither of a frame's two
// neighbours [C, 2] among `shadowed` [F, size] is in a shadow; and its gradient.
double absorption_loss(const float* transmittance, const uint8_t* shadowed, const int64_t* neighbours, int count,
                       int64_t size, double factor, int threads, float* gradient);

}  // namespace ultragray

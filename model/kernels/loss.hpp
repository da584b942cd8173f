// The image part of the training loss on many threads.
#pragma once

#include <string>

namespace ultragray {

// (1 - texture) mean |x - y| + texture (1 - SSIM) of images [C, H, W], both sides at least 11, and its gradient by x,
// [C, H, W].
// The result does not depend on the number of threads.
double image_loss(const float* x, const float* y, int count, int height, int width, double texture, int threads,
                  const std::string& instruction_set, float* gradient);

}  // namespace ultragray

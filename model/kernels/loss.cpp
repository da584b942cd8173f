#include "loss.hpp"

#include <cmath>
#include <memory>
#include <vector>

#include "render.hpp"
#include "threads.hpp"

namespace ultragray {

double image_loss(const float* x, const float* y, int count, int height, int width, const float* weights, int weighted,
                  double texture, int threads, const std::string& instruction_set, float* gradient) {
    const Kernels& kernels = choose_kernels(instruction_set);
    float window[11], sum = 0;
    for (int t = 0; t < 11; ++t) sum += window[t] = std::exp(-0.5f * float((t - 5) * (t - 5)) / (1.5f * 1.5f));
    for (float& weight : window) weight /= sum;
    const double pixels = double(count) * height * width, windows = double(count) * (height - 10) * (width - 10);
    std::vector<ImageLoss> losses(count);
    Phase images{count, [&](int i) {
                     thread_local std::vector<float> scratch;
                     scratch.resize(loss_scratch(height, width));
                     const int64_t at = int64_t(i) * height * width;
                     const int place = i - (count - weighted);
                     losses[i] = kernels.image_loss(
                         x + at, y + at, place < 0 ? nullptr : weights + int64_t(place) * height * width, height, width,
                         window, scratch.data(), float((1.0 - texture) / pixels), float(-texture / windows), gradient + at);
                 }};
    run_phases({&images}, threads);
    ImageLoss total{0, 0};
    for (const ImageLoss& loss : losses) total.l1 += loss.l1, total.ssim += loss.ssim;
    return (1.0 - texture) * total.l1 / pixels + texture * (1.0 - total.ssim / windows);
}

double absorption_loss(const float* transmittance, const uint8_t* shadowed, const int64_t* neighbours, int count,
                       int64_t size, double factor, int threads, float* gradient) {
    const double share = factor / (double(count) * double(size));
    std::vector<double> sums(count);
    Phase frames{count, [&](int c) {
                     const uint8_t *first = shadowed + neighbours[2 * c] * size,
                                   *second = shadowed + neighbours[2 * c + 1] * size;
                     const float* passed = transmittance + c * size;
                     float* by = gradient + c * size;
                     for (int64_t i = 0; i < size; ++i) {
                         const float counts = first[i] | second[i] ? 0.0f : 1.0f;
                         sums[c] += counts * (1.0f - passed[i]);
                         by[i] = float(-share) * counts;
                     }
                 }};
    run_phases({&frames}, threads);
    double sum = 0;
    for (const double one : sums) sum += one;
    return share * sum;
}

}  // namespace ultragray

// Updates of a training's parameters on many threads.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

namespace ultragray {

// One parameter, contiguous, with its gradient and its moments.
struct AdamParameter {
    float* values;
    const float* gradient;
    float *first, *second;
    int64_t count;
    int64_t step;  // from 1
    double rate;
    double penalty;  // of the mean of exp(value), whose gradient is added
};

// One update of each in place; the penalties. The result does not depend on the number of threads.
std::vector<double> adam(const std::vector<AdamParameter>& parameters, double beta1, double beta2, double eps, int threads,
                         const std::string& instruction_set);

}  // namespace ultragray

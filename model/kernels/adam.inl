// Adam (docs/physics.md §7) over a stretch of a parameter, in one pass over memory.

#pragma once

namespace {

// Also adds `by_sum` times the gradient of the sum of exp(value), and returns that sum; 0 where by_sum is 0.
double adam(float* values, const float* gradient, float* first, float* second, int64_t count, const AdamStep& step,
            float by_sum) {
    double sum = 0;
    const auto update = [&](float* value_at, const float* gradient_at, float* first_at, float* second_at) {
        const Floats value = load<Floats>(value_at);
        Floats by = load<Floats>(gradient_at);
        if (by_sum != 0) {
            const Floats grown = exponential(value);
            by += by_sum * grown;
            sum += total(grown);
        }
        const Floats mean = load<Floats>(first_at) * step.beta1 + by * (1.0f - step.beta1);
        const Floats square = load<Floats>(second_at) * step.beta2 + by * by * (1.0f - step.beta2);
        store(first_at, mean), store(second_at, square);
        store(value_at, value - step.rate * mean / (square_root(square) * step.by_root + step.eps));
    };
    int64_t i = 0;
    for (; i + kLanes <= count; i += kLanes) update(values + i, gradient + i, first + i, second + i);
    if (i == count) return sum;
    float rest[4][kLanes] = {};
    float* const arrays[3] = {values + i, first + i, second + i};
    const int left = static_cast<int>(count - i);
    for (int k = 0; k < kLanes; ++k) rest[0][k] = -1e3f;  // nothing is left of its exponential
    for (int a = 0; a < 3; ++a) __builtin_memcpy(rest[a], arrays[a], left * sizeof(float));
    __builtin_memcpy(rest[3], gradient + i, left * sizeof(float));
    update(rest[0], rest[3], rest[1], rest[2]);
    for (int a = 0; a < 3; ++a) __builtin_memcpy(arrays[a], rest[a], left * sizeof(float));
    return sum;
}

}  // namespace

#include "adam.hpp"

#include <algorithm>
#include <cmath>

#include "kernel.hpp"
#include "threads.hpp"

namespace ultragray {

std::vector<double> adam(const std::vector<AdamParameter>& parameters, double beta1, double beta2, double eps, int threads,
                         const std::string& instruction_set) {
    constexpr int64_t kStretch = 16384;
    struct Stretch {
        size_t parameter;
        int64_t begin;
        double sum;
    };
    const Kernels& kernels = choose_kernels(instruction_set);
    std::vector<Stretch> stretches;
    for (size_t p = 0; p < parameters.size(); ++p)
        for (int64_t begin = 0; begin < parameters[p].count; begin += kStretch) stretches.push_back({p, begin, 0.0});
    Phase updates{
        static_cast<int>(stretches.size()), [&](int task) {
            Stretch& own = stretches[task];
            const AdamParameter& p = parameters[own.parameter];
            const double root = std::sqrt(1.0 - std::pow(beta2, double(p.step)));
            const AdamStep step{float(beta1), float(beta2), float(p.rate / (1.0 - std::pow(beta1, double(p.step)))),
                                float(1.0 / root), float(eps)};
            own.sum = kernels.adam(p.values + own.begin, p.gradient + own.begin, p.first + own.begin, p.second + own.begin,
                                   std::min(kStretch, p.count - own.begin), step, float(p.penalty / double(p.count)));
        }};
    run_phases({&updates}, threads);
    std::vector<double> penalties(parameters.size());
    for (const Stretch& own : stretches)
        penalties[own.parameter] += parameters[own.parameter].penalty * own.sum / double(parameters[own.parameter].count);
    return penalties;
}

}  // namespace ultragray

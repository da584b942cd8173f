#include "speckle.hpp"

#include <algorithm>
#include <vector>

#include "threads.hpp"

namespace ultragray {

namespace {
constexpr int kRowsAtOnce = 128;  // rows of samples that two pieces need are computed twice
}

void add_speckle(const SpeckleGrid& grid, const SpeckleView* views, int count, int threads,
                 const std::string& instruction_set, const float* bmode, float* out) {
    const Kernels& kernels = choose_kernels(instruction_set);
    const int at_once = threads == 1 ? grid.height : kRowsAtOnce, pieces = (grid.height + at_once - 1) / at_once;
    Phase rows{count * pieces, [&](int i) {
                   thread_local std::vector<float> scratch;
                   scratch.resize(speckle_scratch(grid));
                   const int first = i % pieces * at_once, last = std::min(first + at_once, grid.height);
                   const int64_t at = int64_t(i / pieces) * grid.height * grid.width;
                   kernels.speckle(grid, views[i / pieces], first, last, bmode ? bmode + at : nullptr, scratch.data(),
                                   out + at);
               }};
    run_phases({&rows}, threads);
}

}  // namespace ultragray

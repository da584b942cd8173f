// Work shared out over threads.
#pragma once

#include <atomic>
#include <cstdint>
#include <functional>

namespace ultragray {

// Tasks 0 … count − 1, taken by several threads.
struct Phase {
    int count;
    std::function<void(int)> task;
    std::atomic<int> next{0}, done{0};
};

// Runs all tasks of `first`, then all of `second`, on up to `threads` threads, the caller's among them: one start of threads
// for both, because that costs as much as a tenth of a small frame. The first exception is rethrown.
void run_phases(Phase& first, Phase& second, int threads);

// Runs `task` on slices [begin, end) of 0 … count − 1.
void run_ranges(int64_t count, const std::function<void(int64_t, int64_t)>& task, int threads);

}  // namespace ultragray
